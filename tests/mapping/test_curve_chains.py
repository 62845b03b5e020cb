import numpy as np
import pytest

from roel_service.mapping.curve_chains import (
    MIN_SPACING_PX,
    SPACING_PX,
    linked,
    points_along,
    smoothed,
    thinned,
)


def arc(count=30, radius_px=40.0, spacing_px=3.0):
    angle = np.arange(count) * spacing_px / radius_px
    points = radius_px * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    tangents = np.stack([-np.sin(angle), np.cos(angle)], axis=-1)
    return points, tangents


def test_points_lie_evenly_along_pieces():
    segments = np.array([[[0.0, 0.0], [9.0, 0.0]], [[5.0, 5.0], [5.0, 6.0]]])
    points, piece = points_along(segments)
    assert piece.tolist() == [0, 0, 0, 0, 1, 1]
    np.testing.assert_allclose(points[:4, 0], [0, SPACING_PX, 2 * SPACING_PX, 9])
    np.testing.assert_allclose(points[4:], segments[1])


def test_thinned_points_keep_their_distance_and_the_strong_ones_stay():
    points = np.array([[0.0, 0.0], [1.0, 0.0], [2.5, 0.0], [3.0, 0.0]])
    kept = thinned(points, np.array([1.0, 9.0, 2.0, 3.0]))
    assert kept.tolist() == [1]  # 3.0 is just at the distance of 2
    apart = thinned(points * MIN_SPACING_PX * 2, np.ones(4))
    assert apart.tolist() == [0, 1, 2]


@pytest.mark.parametrize("seed", range(3))
def test_an_arc_is_one_chain_in_order_whatever_the_order_and_sign(seed):
    rng = np.random.default_rng(seed)
    points, tangents = arc()
    order = rng.permutation(len(points))
    signs = rng.choice([-1.0, 1.0], (len(points), 1))
    (chain,) = linked(points[order], (signs * tangents)[order])
    place = order[chain]
    assert (np.diff(place) == 1).all() or (np.diff(place) == -1).all()
    assert len(chain) == len(points)


def test_crossing_edges_stay_apart():
    points, tangents = arc()
    straight = np.stack([np.linspace(20, 60, 14), np.full(14, 15.0)], axis=-1)
    along = np.tile([1.0, 0.0], (14, 1))
    chains = linked(np.concatenate([points, straight]), np.concatenate([tangents, along]))
    for chain in chains:
        assert (chain < len(points)).all() or (chain >= len(points)).all()


def test_few_points_are_no_chain():
    points, tangents = arc(5)
    assert linked(points, tangents) == []
    assert linked(points[:1], tangents[:1]) == []


class TestSmoothed:
    ANGLE_RAD = 3.0 / 240.0

    def test_depths_that_agree_stay(self):
        true = 0.5 + 0.001 * np.arange(20)
        smooth, deviation_px = smoothed(true, np.full(20, 1e5), np.full(20, 10), self.ANGLE_RAD)
        np.testing.assert_allclose(smooth, true, rtol=1e-4)
        assert deviation_px.max() < 0.05

    def test_neighbours_outvote_a_point_of_another_edge(self):
        inverse_depth = np.full(20, 0.5)
        inverse_depth[9] = 0.8
        smooth, deviation_px = smoothed(
            inverse_depth, np.full(20, 1e5), np.full(20, 10), self.ANGLE_RAD
        )
        assert abs(smooth[9] - 0.5) < 0.005
        # 0.3/m at 100 px m: sqrt(1e5 / 10).
        assert deviation_px[9] > 29
        assert np.delete(deviation_px, 9).max() < 1

    def test_points_without_a_depth_take_it_from_both_sides(self):
        inverse_depth = np.where(np.arange(20) // 5 == 1, 0.0, 0.4)
        information = np.where(inverse_depth > 0, 1e5, 0.0)
        smooth, deviation_px = smoothed(inverse_depth, information, np.full(20, 10), self.ANGLE_RAD)
        np.testing.assert_allclose(smooth, 0.4, rtol=1e-3)
        assert np.isinf(deviation_px[5:10]).all()

    def test_no_depth_at_all_stays_none(self):
        _, deviation_px = smoothed(np.zeros(8), np.zeros(8), np.zeros(8, np.int64), 0.01)
        assert np.isinf(deviation_px).all()
