import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roel_service.geometry.projection import fundamental_matrix, project
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.segments import (
    angle_rad,
    bi_overlap,
    endpoint_distance,
    epipolar_iou,
    facing_part,
    inner_segment_distance,
    left_normal,
    length,
    midpoint_perpendicular,
    overlap,
    perpendicular,
    perpendicular_one_way,
    perspective_distance,
    point_line_distance,
    point_line_offset,
    point_segment_distance,
    position_along,
    reaches_box,
    sensitivity_rad,
    uncertainty_m,
)

from .strategies import arrays, poses, segments

LONG = np.array([[0.0, 0.0], [10.0, 0.0]])
# Beside the second half of LONG and past its end, 2 above.
ABOVE = np.array([[6.0, 2.0], [12.0, 2.0]])
CROSSING = np.array([[5.0, -1.0], [5.0, 3.0]])
POINT = np.array([[3.0, 1.0], [3.0, 1.0]])

SYMMETRIC = [angle_rad, perpendicular, bi_overlap, midpoint_perpendicular, endpoint_distance]
UNDIRECTED = [
    *SYMMETRIC,
    perpendicular_one_way,
    overlap,
    inner_segment_distance,
]
OF_LINES = [angle_rad, perpendicular, perpendicular_one_way, midpoint_perpendicular]


def lifted(segment):
    """The same segment in space."""
    return np.concatenate([segment, np.zeros((*segment.shape[:-1], 1))], axis=-1)


@pytest.mark.parametrize(
    ("distance", "expected"),
    [
        (perpendicular, 2.0),
        (perpendicular_one_way, 2.0),
        (midpoint_perpendicular, 2.0),
        (inner_segment_distance, 2.0),
        (overlap, 2 / 3),  # LONG covers 4 of the 6 of ABOVE
        (bi_overlap, 2 / 3),
        (endpoint_distance, np.hypot(6, 2) + np.hypot(2, 2)),
        (angle_rad, 0.0),
    ],
)
def test_values_of_two_parallel_segments(distance, expected):
    assert distance(LONG, ABOVE) == pytest.approx(expected, rel=1e-14)
    assert distance(lifted(LONG), lifted(ABOVE)) == pytest.approx(expected, rel=1e-14)


def test_overlap_is_a_share_of_the_second_segment():
    assert overlap(ABOVE, LONG) == pytest.approx(0.4)
    assert overlap(LONG, ABOVE) == pytest.approx(2 / 3)


def test_overlap_of_disjoint_segments_is_minus_the_gap():
    beyond = LONG + np.array([13.0, 5.0])
    assert overlap(beyond, LONG) == pytest.approx(-0.3)
    assert overlap(LONG, LONG) == 1.0


def test_one_way_distance_forgives_a_short_segment_near_a_long_line():
    short = np.array([[0.0, 0.1], [1.0, 0.2]])
    assert perpendicular_one_way(short, LONG) == pytest.approx(0.2)
    # The other way the short segment is prolonged to x = 10: 0.1 + 0.1 * 10 there.
    assert perpendicular_one_way(LONG, short) == pytest.approx(1.1 / np.hypot(1, 0.1))
    assert perpendicular(short, LONG) == perpendicular_one_way(LONG, short)


def test_inner_segment_distance_does_not_grow_with_the_longer_segment():
    short = np.array([[0.0, 0.1], [1.0, 0.2]])
    longer = LONG * 100
    assert inner_segment_distance(short, longer) == pytest.approx(
        inner_segment_distance(short, LONG), rel=1e-9
    )
    assert perpendicular(short, longer) > 50


@pytest.mark.parametrize(
    "other",
    [
        CROSSING,  # orthogonal
        LONG + np.array([20.0, 0.0]),  # disjoint
        LONG + np.array([10.0, 0.0]),  # touching
        LONG + np.array([10.0 - 1e-12, 2.0]),  # touching but for rounding
    ],
)
def test_nothing_faces_is_infinitely_far(other):
    assert inner_segment_distance(LONG, other) == np.inf
    assert inner_segment_distance(other, LONG) == np.inf
    assert np.isnan(facing_part(LONG, other)).all()


def test_facing_part_follows_the_ends_of_the_other_segment():
    np.testing.assert_allclose(facing_part(ABOVE, LONG), [[6, 0], [10, 0]])
    np.testing.assert_allclose(facing_part(ABOVE[::-1], LONG), [[10, 0], [6, 0]])


@pytest.mark.parametrize("turn_rad", [0.0, 1e-9, 1e-4, 0.5, np.pi / 2, 3.0])
def test_angle_is_unsigned_and_exact_near_zero(turn_rad):
    turned = np.array([[1.0, 1.0], [1.0 + np.cos(turn_rad), 1.0 + np.sin(turn_rad)]])
    expected = min(turn_rad, np.pi - turn_rad)
    # The ends are rounded at 2e-16.
    assert angle_rad(LONG, turned) == pytest.approx(expected, abs=1e-15)


@pytest.mark.parametrize("distance", UNDIRECTED)
@given(a=segments(), b=segments())
def test_swapped_ends_change_nothing(distance, a, b):
    value = distance(a, b)
    for first, second in ((a[::-1], b), (a, b[::-1])):
        # Coordinates up to 10, lengths from 0.1: prolonging multiplies roundings by 200.
        np.testing.assert_allclose(distance(first, second), value, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("distance", [*SYMMETRIC, inner_segment_distance])
@given(a=segments(), b=segments())
def test_symmetric_distances_do_not_mind_the_order(distance, a, b):
    assert distance(a, b) == distance(b, a)


@pytest.mark.parametrize("distance", OF_LINES)
@given(a=segments())
def test_distance_to_itself_is_zero(distance, a):
    assert distance(a, a) == pytest.approx(0.0, abs=1e-13)


@pytest.mark.parametrize("distance", [*SYMMETRIC, perpendicular_one_way, overlap])
@given(a=segments(), b=segments(), motion=poses())
def test_rigid_motion_changes_nothing(distance, a, b, motion):
    np.testing.assert_allclose(
        distance(motion @ a, motion @ b), distance(a, b), rtol=1e-9, atol=1e-10
    )


@pytest.mark.parametrize("distance", [*UNDIRECTED, endpoint_distance])
def test_leading_axes_broadcast_to_all_pairs(distance):
    rng = np.random.default_rng(11)
    a, b = rng.normal(size=(4, 2, 3)), rng.normal(size=(5, 2, 3))
    table = distance(a[:, None], b[None])
    assert table.shape == (4, 5)
    assert table[3, 2] == pytest.approx(distance(a[3], b[2]), rel=1e-12)


@pytest.mark.parametrize("distance", [angle_rad, perpendicular, bi_overlap, midpoint_perpendicular])
def test_zero_length_has_no_direction_and_passes_no_threshold(distance):
    value = distance(LONG, POINT)
    assert np.isnan(value)
    assert not value < 1e9
    assert not value > -1e9


def test_zero_length_faces_nothing():
    assert inner_segment_distance(LONG, POINT) == np.inf


@pytest.mark.parametrize("size_m", [1.0, 100.0])
def test_perspective_distance_is_relative_depth_and_free_of_scale(size_m):
    near = size_m * np.array([[0.1, 0.0, 1.0], [0.2, 0.1, 2.0]])
    # The same rays, 5 % and 10 % further out.
    far = near * np.array([[1.05], [1.10]])
    on_ray = np.linalg.norm(near[1]) / near[1, 2]
    assert perspective_distance(near, far) == pytest.approx(0.10 * on_ray, rel=1e-12)


def test_perspective_distance_refuses_ends_behind_the_camera():
    behind = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 2.0]])
    assert perspective_distance(behind, behind) == np.inf


@pytest.mark.parametrize(
    ("tilt_rad", "expected_rad"), [(0.0, 0.0), (0.3, 0.3), (np.pi / 2, np.pi / 2), (-0.3, 0.3)]
)
def test_sensitivity_counts_from_broadside_to_along_the_ray(tilt_rad, expected_rad):
    # Short, so that the mid-point of the projection is on the optical axis.
    half = 1e-6 * np.array([np.cos(tilt_rad), 0.0, np.sin(tilt_rad)])
    segment = np.array([0.0, 0.0, 3.0]) + np.stack([-half, half])
    assert sensitivity_rad(segment) == pytest.approx(expected_rad, abs=1e-6)


def test_sensitivity_of_a_segment_behind_the_camera_is_nan():
    assert np.isnan(sensitivity_rad(np.array([[0.0, 0, -1], [1.0, 0, 1]])))


def test_uncertainty_is_the_image_error_at_mean_depth():
    segment = np.array([[0.0, 0.0, 2.0], [1.0, 0.0, 4.0]])
    assert uncertainty_m(segment, 2.0, 300.0) == pytest.approx(0.02)


def test_signed_offset_is_positive_to_the_left_normal():
    np.testing.assert_array_equal(left_normal(LONG), [0.0, 1.0])
    np.testing.assert_array_equal(
        point_line_offset(np.array([[20.0, 3.0], [0.0, -3.0]]), LONG), [3, -3]
    )


@given(arrays((6, 2), -10, 10), segments(dimensions=2))
def test_signed_offset_has_the_size_of_the_distance(points_px, segment_px):
    offset = point_line_offset(points_px, segment_px)
    distance = point_line_distance(points_px, segment_px)
    np.testing.assert_allclose(np.abs(offset), distance, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("point", "expected"), [([4.0, 2.0], 2.0), ([-3.0, 4.0], 5.0), ([13.0, -4.0], 5.0)]
)
def test_point_segment_distance_ends_with_the_segment(point, expected):
    assert point_segment_distance(np.array(point), LONG) == expected
    assert point_segment_distance(np.array(point), LONG[::-1]) == expected


def test_point_segment_distance_to_a_segment_of_zero_length_is_that_to_a_point():
    assert point_segment_distance(np.array([6.0, 5.0]), POINT) == 5.0


@given(arrays((5, 3), -10, 10), segments())
def test_point_segment_distance_is_the_smallest_over_its_points(points_m, segment):
    distance = point_segment_distance(points_m, segment)
    fraction = np.linspace(0, 1, 200)[:, None]
    samples = segment[0] + fraction * (segment[1] - segment[0])
    sampled = np.linalg.norm(points_m[:, None] - samples, axis=-1).min(axis=1)
    assert (distance <= sampled + 1e-12).all()
    assert (sampled - distance <= length(segment) / 199).all()


@given(segments(), st.floats(-2, 3))
def test_position_along_counts_in_lengths(segment, fraction):
    point = segment[0] + fraction * (segment[1] - segment[0])
    # 1e-15 m over the shortest length of 0.1 m.
    assert position_along(point, segment) == pytest.approx(fraction, abs=1e-12)


K = np.array([[300.0, 0, 160], [0, 300.0, 120], [0, 0, 1]])
# A step to the right and a slight turn: epipolar lines are nearly horizontal.
T_2_1 = SE3(rotation=rotation_from_vector([0.0, 0.05, 0.01]), translation=np.array([-0.3, 0.02, 0]))
FUNDAMENTAL = fundamental_matrix(K, K, T_2_1)
UPRIGHT = np.array([[0.1, -0.5, 2.0], [0.2, 0.5, 2.5]])


def views(segment_1, segment_2):
    return project(segment_1, K), project(T_2_1 @ segment_2, K)


def test_epipolar_iou_of_the_same_segment_is_one():
    segment_1_px, segment_2_px = views(UPRIGHT, UPRIGHT)
    assert epipolar_iou(segment_1_px, segment_2_px, FUNDAMENTAL) == pytest.approx(1.0, abs=1e-9)
    assert epipolar_iou(segment_1_px[::-1], segment_2_px, FUNDAMENTAL) == pytest.approx(
        1.0, abs=1e-9
    )


def test_epipolar_iou_of_a_half_seen_segment_is_its_share():
    start, end = UPRIGHT
    segment_1_px, whole_px = views(UPRIGHT, UPRIGHT)
    middle_px = project(T_2_1 @ (start + 0.6 * (end - start)), K)
    part_px = np.stack([whole_px[0], middle_px])
    share = length(part_px) / length(whole_px)
    assert epipolar_iou(segment_1_px, part_px, FUNDAMENTAL) == pytest.approx(share, abs=1e-9)


def test_epipolar_iou_of_disjoint_segments_is_negative():
    start, end = UPRIGHT
    beyond = np.stack([end + 0.5 * (end - start), end + (end - start)])
    assert epipolar_iou(*views(UPRIGHT, beyond), FUNDAMENTAL) < 0


def test_epipolar_iou_is_nan_for_a_line_along_its_epipolar_lines():
    sideways = fundamental_matrix(
        np.eye(3), np.eye(3), SE3(rotation=np.eye(3), translation=np.array([1.0, 0, 0]))
    )
    horizontal = np.array([[0.0, 0.5], [1.0, 0.5]])
    assert np.isnan(epipolar_iou(horizontal, horizontal, sideways))


@given(hnp.arrays(np.float64, (1, 2, 3), elements=st.integers(-8, 8).map(float)))
def test_a_segment_reaches_a_box_if_a_point_of_it_does(segments):
    lower, upper = np.array([-2.0, -3.0, 0.0]), np.array([3.0, 1.0, 2.0])
    # Ends are whole numbers at most 16 apart: where a segment enters and leaves is told by points
    # whose spacing divides every such ratio.
    shares = np.unique([i / d for d in range(1, 17) for i in range(d + 1)])
    points = segments[:, 0] + shares[:, None] * (segments[:, 1] - segments[:, 0])
    near = 1e-12
    inside = ((points >= lower - near) & (points <= upper + near)).all(axis=1).any()
    assert reaches_box(segments, lower - near, upper + near).item() == inside


def test_every_segment_reaches_a_box_without_bounds():
    segments = np.array([[[0.0, 0, 0], [1, 0, 0]], [[5.0, 5, 5], [5, 5, 5]]])
    unbounded = np.full(3, np.inf)
    assert reaches_box(segments, -unbounded, unbounded).all()
