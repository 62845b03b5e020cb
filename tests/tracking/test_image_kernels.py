import numpy as np
import pytest

from roel_service.geometry import projection, segments
from roel_service.geometry.se3 import SE3
from roel_service.tracking import image_kernels

from .synthetic import CAMERA, motion, walls

K = CAMERA.matrix
SIZE = (CAMERA.width, CAMERA.height)
POSE = motion(np.array(130_000))


def directions(lines):
    along = lines[:, 1] - lines[:, 0]
    return along / np.linalg.norm(along, axis=1, keepdims=True)


def projected(lines, pose=POSE, min_depth_m=0.05):
    return image_kernels.project(lines, pose.rotation, pose.translation, K, *SIZE, min_depth_m)


def distances_at(pose, xy_px, lines):
    count = len(lines)
    return image_kernels.distances(
        xy_px,
        np.zeros(count, np.int64),
        np.arange(count, dtype=np.int32),
        pose.rotation[None],
        pose.translation[None],
        K,
        lines,
        directions(lines),
    )


class TestProject:
    def test_ends_in_the_picture_are_where_a_pinhole_puts_them(self):
        lines = walls(3)
        expected = projection.project(POSE.inverse() @ lines, K)
        images, depths_m = projected(lines)
        inside = ((expected >= 0) & (expected <= np.array(SIZE) - 1)).all(axis=(1, 2))
        assert inside.sum() > 10
        np.testing.assert_allclose(images[inside].reshape(-1, 2, 2), expected[inside], atol=1e-9)
        assert (depths_m[inside] > 1.5).all()

    def test_the_rest_is_cut_to_the_picture_on_the_same_line(self):
        lines = walls(3)
        ends_px = projection.project(POSE.inverse() @ lines, K)
        images, depths_m = projected(lines)
        seen = depths_m > 0
        cut = images[seen].reshape(-1, 2, 2)
        assert (cut >= -1e-9).all()
        assert (cut <= np.array(SIZE) - 1 + 1e-9).all()
        for part, whole in zip(cut, ends_px[seen], strict=True):
            away_px = segments.point_line_distance(part, whole)
            np.testing.assert_allclose(away_px, 0.0, atol=1e-9)

    def test_what_is_behind_the_camera_is_not_seen(self):
        behind = walls(3) - np.array([0.0, 0.0, 10.0])
        images, depths_m = projected(behind)
        assert not images.any()
        assert not depths_m.any()

    def test_a_line_through_the_camera_plane_is_cut_at_the_nearest_depth(self):
        line = np.array([[[0.0, 0.1, -1.0], [0.0, 0.1, 1.0]]])
        images, _ = projected(line, SE3.identity(), min_depth_m=0.5)
        far, near = sorted(images.reshape(2, 2)[:, 1])
        assert far == pytest.approx(CAMERA.cy_px + 0.1 * CAMERA.fy_px / 1.0)
        assert near == pytest.approx(CAMERA.cy_px + 0.1 * CAMERA.fy_px / 0.5)


class TestDrawNearest:
    def test_every_pixel_within_reach_names_its_nearest_piece(self):
        images = np.array([[20.0, 30.0, 120.0, 45.0], [60.0, 20.0, 70.0, 90.0]])
        nearest = image_kernels.draw_nearest(images, 4.0, *SIZE)
        # Above the middle of the flat one, and beside the middle of the steep one.
        assert nearest[34, 40] == 0
        assert nearest[70, 65] == 1
        assert nearest[100, 100] == image_kernels.NO_PIECE
        assert set(np.unique(nearest)) == {-1, 0, 1}


class TestDistances:
    def test_derivatives_are_those_of_central_differences(self):
        lines = walls(5)[:20]
        rng = np.random.default_rng(0)
        middle_px = projection.project(POSE.inverse() @ lines.mean(axis=1), K)
        xy_px = middle_px + rng.uniform(-5.0, 5.0, middle_px.shape)
        _, jacobian = distances_at(POSE, xy_px, lines)
        for axis in range(6):
            step = 1e-6 * np.eye(6)[axis]
            ahead, _ = distances_at(POSE.retract(step), xy_px, lines)
            behind, _ = distances_at(POSE.retract(-step), xy_px, lines)
            expected = (ahead - behind) / 2e-6
            # Relative to the focal length, the size of a turn's derivative.
            np.testing.assert_allclose(jacobian[:, axis], expected, atol=1e-6 * K[0, 0])

    def test_they_are_distances_from_the_projected_lines(self):
        lines = walls(5)
        ends_px = projection.project(POSE.inverse() @ lines, K)
        whole = np.isfinite(ends_px).all(axis=(1, 2))
        xy_px = ends_px[whole].mean(axis=1) + np.array([3.0, -2.0])
        residual_px, _ = distances_at(POSE, xy_px, lines[whole])
        for point, ends, found in zip(xy_px, ends_px[whole], residual_px, strict=True):
            expected = segments.point_line_distance(point[None], ends)[0]
            assert abs(found) == pytest.approx(expected, abs=1e-9)


class TestNormalEquations:
    def test_they_are_sums_of_outer_products(self):
        rng = np.random.default_rng(1)
        residual, weight, after = rng.normal(size=(3, 50))
        weight = np.maximum(weight, 0.0)
        by_pose = rng.normal(size=(50, 6))
        information, slope = image_kernels.normal_equations(residual, by_pose, after, weight)
        jacobian = np.concatenate([by_pose, after[:, None] * by_pose], axis=1)
        np.testing.assert_allclose(information, jacobian.T @ (weight[:, None] * jacobian))
        np.testing.assert_allclose(slope, jacobian.T @ (weight * residual))


class TestSupport:
    def test_events_count_on_beside_and_along_a_piece(self):
        images = np.array([[10.0, 50.0, 50.0, 50.0]])
        # Along the first half of the piece, and one beside it.
        x_px = np.append(np.arange(10.0, 30.0), 20.0)
        xy_px = np.stack([x_px, np.append(np.full(20, 50.0), 53.0)], axis=1)
        residual_px = xy_px[:, 1] - 50.0
        on, beside, occupied = image_kernels.support(
            xy_px, np.zeros(21, np.int32), residual_px, images, 1.0, (2.0, 4.0), 4.0
        )
        assert (on[0], beside[0]) == (20, 1)
        assert occupied[0] == 0.5


def test_what_edges_say_adds_up_to_what_all_events_say():
    rng = np.random.default_rng(3)
    by_pose, after_s, weight = rng.normal(size=(50, 6)), rng.normal(size=50), rng.uniform(size=50)
    edge = rng.integers(0, 4, 50)
    total, _ = image_kernels.normal_equations(np.zeros(50), by_pose, after_s, weight)
    of_edges = image_kernels.information_by_edge(by_pose, after_s, weight, edge, 4)
    np.testing.assert_allclose(of_edges.sum(axis=0), total, atol=1e-9)
    first = edge == 2
    of_one, _ = image_kernels.normal_equations(
        np.zeros(first.sum()), by_pose[first], after_s[first], weight[first]
    )
    np.testing.assert_allclose(of_edges[2], of_one, atol=1e-9)


def test_steps_of_a_pose_are_those_of_the_group():
    rng = np.random.default_rng(3)
    pose = SE3.identity().retract(rng.normal(size=6))
    steps = np.concatenate([rng.normal(size=(5, 6)), 1e-6 * rng.normal(size=(2, 6))])
    rotation, centre = image_kernels.retracted(pose.rotation, pose.translation, steps)
    np.testing.assert_allclose(rotation, pose.retract(steps).rotation, atol=1e-14)
    np.testing.assert_allclose(centre, pose.retract(steps).translation, atol=1e-14)


def test_all_events_of_a_piece_weigh_no_more_than_it_is_known():
    count = 10_000
    weight = image_kernels.event_weights(
        np.zeros(count + 2),
        np.r_[np.zeros(count, np.int32), np.array([1, 2], np.int32)],
        np.array([True, True, False]),
        np.full(3, 0.1),
        0.5,
        2.0,
    )
    assert 9.9 < weight[:count].sum() < 1 / 0.1
    assert weight[count] == 1 / (0.5 + 0.1)
    assert weight[count + 1] == 0.0
