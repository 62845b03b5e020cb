import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from roel_service.geometry import segments
from roel_service.geometry.plucker import (
    orthonormal_from_plucker,
    plucker_from_endpoints,
    plucker_from_orthonormal,
    retract_orthonormal,
)
from roel_service.geometry.projection import project
from roel_service.geometry.reprojection import end_line_distances_px, end_line_jacobians
from roel_service.geometry.se3 import SE3

from .strategies import BATCH_SHAPES, arrays, central_difference, poses

K = np.array([[200.0, 0.0, 159.5], [0.0, 210.0, 119.5], [0.0, 0.0, 1.0]])


@st.composite
def seen_lines(draw):
    """A pose, a segment before it that is some pixels long, and an observation somewhere."""
    pose = draw(poses(size_m=2.0))
    in_camera = draw(arrays((2, 3))) * np.array([2.0, 2.0, 1.0]) + np.array([0.0, 0.0, 3.0])
    image = project(in_camera, K)
    assume(np.linalg.norm(image[1] - image[0]) > 20)
    observed = image + 10 * draw(arrays((2, 2)))
    return pose, pose @ in_camera, observed


@given(seen_lines())
def test_distances_are_those_from_the_image_of_the_line(drawn):
    pose, segment, observed = drawn
    distance = end_line_distances_px(observed, pose, *plucker_from_endpoints(segment), K)
    image = project(pose.inverse() @ segment, K)
    expected = np.abs(segments.point_line_offset(observed, image[None]))
    # px, far from the segment a turn by rounding counts some hundredfold.
    np.testing.assert_allclose(np.abs(distance), expected, rtol=0, atol=1e-8)


@given(seen_lines())
def test_the_line_itself_is_at_distance_zero(drawn):
    pose, segment, _ = drawn
    image = project(pose.inverse() @ segment, K)
    distance = end_line_distances_px(image, pose, *plucker_from_endpoints(segment), K)
    np.testing.assert_allclose(distance, 0, rtol=0, atol=1e-8)


@given(seen_lines())
def test_signs_are_the_line_s_and_tell_the_sides(drawn):
    pose, segment, observed = drawn
    direction, moment = plucker_from_endpoints(segment)
    distance = end_line_distances_px(observed, pose, direction, moment, K)
    turned = end_line_distances_px(observed, pose, -direction, -moment, K)
    np.testing.assert_array_equal(distance, -turned)
    image = project(pose.inverse() @ segment, K)
    mirrored = observed - 2 * (
        segments.point_line_offset(observed, image[None])[:, None] * segments.left_normal(image)
    )
    across = end_line_distances_px(mirrored, pose, direction, moment, K)
    np.testing.assert_allclose(across, -distance, rtol=0, atol=1e-7)


@given(seen_lines())
def test_jacobians_agree_with_central_differences(drawn):
    pose, segment, observed = drawn
    U, phi = orthonormal_from_plucker(*plucker_from_endpoints(segment))
    by_line, by_pose = end_line_jacobians(observed, pose, U, phi, K)
    numeric_line = central_difference(
        lambda delta: end_line_distances_px(
            observed, pose, *plucker_from_orthonormal(*retract_orthonormal(U, phi, delta)), K
        ),
        4,
        1e-6,
    )
    numeric_pose = central_difference(
        lambda delta: end_line_distances_px(
            observed, pose.retract(delta), *plucker_from_orthonormal(U, phi), K
        ),
        6,
        1e-6,
    )
    # Rounding of 1e-12 px over the step, truncation of third derivatives: both against the size.
    for analytic, numeric in ((by_line, numeric_line), (by_pose, numeric_pose)):
        np.testing.assert_allclose(analytic, numeric, rtol=0, atol=1e-6 * np.abs(numeric).max())


@pytest.mark.parametrize("shape", BATCH_SHAPES)
def test_batch_axes_lead(shape):
    rng = np.random.default_rng(0)
    segment = rng.uniform(-1, 1, (*shape, 2, 3)) + np.array([0.0, 0.0, 4.0])
    still = SE3(
        rotation=np.broadcast_to(np.eye(3), (*shape, 3, 3)), translation=np.zeros((*shape, 3))
    )
    observed = rng.uniform(0, 100, (*shape, 2, 2))
    direction, moment = plucker_from_endpoints(segment)
    assert end_line_distances_px(observed, still, direction, moment, K).shape == (*shape, 2)
    by_line, by_pose = end_line_jacobians(
        observed, still, *orthonormal_from_plucker(direction, moment), K
    )
    assert by_line.shape == (*shape, 2, 4)
    assert by_pose.shape == (*shape, 2, 6)


def test_a_line_through_the_camera_centre_is_nan():
    still = SE3.identity()
    ray, nothing = np.array([0.0, 0.0, 1.0]), np.zeros(3)
    observed = np.array([[10.0, 20.0], [30.0, 40.0]])
    assert np.isnan(end_line_distances_px(observed, still, ray, nothing, K)).all()
    for jacobian in end_line_jacobians(observed, still, *orthonormal_from_plucker(ray, nothing), K):
        assert np.isnan(jacobian).all()
