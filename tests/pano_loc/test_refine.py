import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit
from roel_service.pano_loc import refine_kernels
from roel_service.pano_loc.prepare import prepare_map
from roel_service.pano_loc.refine import (
    FINAL_GATE_RAD,
    FINAL_SLACK_RAD,
    FINAL_WIDTHS_RAD,
    _refined,
    distinct,
    explained,
    lines_nearby,
    match,
    sample_arcs,
)
from roel_service.pano_loc.search import Candidates
from tests.pano_loc.rooms import map_of, pose, seen_from, segments_of


@pytest.fixture(scope="module")
def prepared():
    return prepare_map(map_of(), LocalizeConfig())


def residual(T, ray, segment):
    normal = np.cross(segment[0] - T.translation, segment[1] - T.translation)
    return T.rotate(ray) @ normal / np.linalg.norm(normal)


@pytest.mark.parametrize("near", [1.0, 0.02])
def test_the_jacobian_is_the_derivative_of_the_residual(near):
    rng = np.random.default_rng(1)
    for _ in range(10):
        T = pose(*rng.normal(size=6))
        segment = T.translation + near * rng.normal(size=3) + rng.normal(size=(2, 3))
        ray = unit(rng.normal(size=3))
        normal, moment, *_ = refine_kernels.viewed_lines(segment[None], T.translation)
        J = np.empty(6)
        refine_kernels.jacobian(T.rotate(ray), segment, normal[0], moment[0], J)
        step = 1e-6
        differences = [
            residual(T.retract(step * e), ray, segment)
            - residual(T.retract(-step * e), ray, segment)
            for e in np.eye(6)
        ]
        np.testing.assert_allclose(J, np.array(differences) / (2 * step), rtol=1e-5, atol=1e-7)


def test_rays_find_their_lines_at_the_true_pose(prepared):
    T = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)
    samples = sample_arcs(seen_from(T, segments_of()), 0.05)
    nearby = lines_nearby(T, samples, prepared)
    found = match(T, samples, prepared, nearby, FINAL_GATE_RAD)
    # Lines that pass so close to the viewer that they have no image are left out.
    assert (found.line >= 0).mean() > 0.95
    assert np.abs(found.residual).max() < 1e-9
    assert explained(T, samples, prepared, nearby) > 0.97


def test_refinement_finds_the_exact_pose_from_near_by(prepared):
    T = pose(1.7, 1.6, 1.4, 0.1, 0.2, 0.8)
    samples = sample_arcs(seen_from(T, segments_of()), 0.05)
    start = T.retract(np.array([0.01, -0.01, 0.01, 0.02, -0.02, 0.02]))
    guess = Candidates(
        poses=SE3(rotation=start.rotation[None], translation=start.translation[None]),
        score=np.zeros(1),
    )
    found = _refined(guess, samples, prepared, FINAL_WIDTHS_RAD, FINAL_SLACK_RAD, len(prepared))
    # Convergence of a few steps: a tenth of a millimetre and of a milliradian.
    np.testing.assert_allclose(T.local(found.poses[0]), np.zeros(6), atol=1e-4)


def test_of_two_poses_that_are_one_the_better_stays():
    turns, places = np.tile(np.eye(3), (3, 1, 1)), np.array([[0.0, 0, 0], [0.1, 0, 0], [2.0, 0, 0]])
    found = distinct(
        Candidates(poses=SE3(rotation=turns, translation=places), score=np.array([1.0, 2.0, 1.5])),
        5,
    )
    assert found.poses.translation[:, 0].tolist() == [0.1, 2.0]
