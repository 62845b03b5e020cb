from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.geometry.plucker import plucker_from_endpoints, transform_lines
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.scene.lines import InfiniteLines, LineMap, LineObservations, LineTracks

SEGMENTS = np.array([[[0.0, 0, 0], [1, 0, 0]], [[1.0, 2, 3], [1, 2, 5]]])
T_B_A = SE3(rotation=rotation_from_vector([0.3, -0.2, 0.5]), translation=np.array([1.0, 2.0, -3.0]))


def line_map(**columns):
    values = {
        "segments": SEGMENTS,
        "observation_count": [3, 4],
        "rms_residual_px": [0.1, 0.2],
        "sigma_m": [0.01, 0.02],
    }
    return LineMap(**(values | columns))


def observations(**columns):
    values = {
        "frame": [0, 0, 2],
        "segments_px": np.zeros((3, 2, 2)),
        "polarity": [1, -1, 0],
        "normal_speed_px_per_ms": np.zeros(3),
        "event_offsets": [0, 2, 2, 3],
        "event_xy_px": np.zeros((3, 2)),
        "event_dt_us": [-5, 6, 7],
    }
    return LineObservations(**(values | columns))


def test_lengths_are_those_of_the_segments():
    np.testing.assert_array_equal(line_map().lengths_m, [1.0, 2.0])


def test_moved_map_keeps_lengths_and_statistics():
    moved = line_map().transformed(T_B_A)
    np.testing.assert_allclose(moved.lengths_m, [1.0, 2.0], rtol=1e-14)
    np.testing.assert_array_equal(moved.segments[0, 0], T_B_A.translation)
    np.testing.assert_array_equal(moved.observation_count, [3, 4])
    np.testing.assert_array_equal(moved.sigma_m, np.float32([0.01, 0.02]))


def test_moving_there_and_back_is_no_move():
    back = line_map().transformed(T_B_A).transformed(T_B_A.inverse())
    np.testing.assert_allclose(back.segments, SEGMENTS, rtol=0, atol=1e-14)


def test_map_of_bare_segments_knows_nothing_else():
    bare = LineMap.from_segments(SEGMENTS)
    assert len(bare) == 2
    assert not bare.observation_count.any()
    assert not bare.sigma_m.any()
    assert len(LineMap.from_segments(np.empty((0, 2, 3))).lengths_m) == 0


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("segments", np.zeros((2, 3, 2))),
        ("segments", np.full((2, 2, 3), np.nan)),
        ("observation_count", [1]),
        ("rms_residual_px", [np.nan, 0]),
        ("sigma_m", [0.1, np.inf]),
    ],
)
def test_wrong_maps_are_refused_by_column(column, value):
    with pytest.raises(ValueError, match=column):
        line_map(**{column: value})


@pytest.mark.parametrize(
    ("column", "value"),
    [
        ("segments_px", np.zeros((2, 2, 2))),
        ("polarity", [1, 1]),
        ("event_offsets", [0, 2, 3]),
        ("event_offsets", [0, 2, 1, 3]),
        ("event_offsets", [0, 2, 2, 4]),
        ("event_xy_px", np.zeros((4, 2))),
        ("normal_speed_px_per_ms", [0, np.nan, 0]),
    ],
)
def test_wrong_observations_are_refused_by_column(column, value):
    with pytest.raises(ValueError, match=column):
        observations(**{column: value})


def test_events_of_an_observation_are_a_range_of_the_columns():
    seen = observations()
    parts = [seen.event_dt_us[start:stop] for start, stop in pairwise(seen.event_offsets)]
    assert [part.tolist() for part in parts] == [[-5, 6], [], [7]]


@given(st.lists(st.integers(0, 4), max_size=6), st.randoms(use_true_random=False))
def test_tracks_give_back_the_lists_they_were_made_of(sizes, random):
    members = list(range(sum(sizes)))
    random.shuffle(members)
    cuts = np.cumsum([0, *sizes])
    lists = [np.array(members[start:stop], np.int32) for start, stop in pairwise(cuts)]
    tracks = LineTracks.from_lists(lists)
    assert len(tracks) == len(lists)
    for index, expected in enumerate(lists):
        np.testing.assert_array_equal(tracks[index], expected)


def test_observations_shared_by_tracks_are_told_but_allowed():
    assert LineTracks(offsets=[0, 2, 3], observation=[4, 1, 3]).is_exclusive()
    assert not LineTracks(offsets=[0, 2, 3], observation=[4, 1, 4]).is_exclusive()


def test_tracks_from_rows_keep_the_order_of_rows_and_empty_tracks():
    tracks = LineTracks.from_rows(np.array([2, 0, 2]), np.array([7, 5, 6], np.int32), 4)
    assert [tracks[index].tolist() for index in range(4)] == [[5], [], [7, 6], []]
    np.testing.assert_array_equal(tracks.sizes, [1, 0, 2, 0])
    np.testing.assert_array_equal(tracks.track_of_row, [0, 2, 2])


@pytest.mark.parametrize("chosen", [np.array([2, 0]), np.array([True, False, True])])
def test_taken_tracks_follow_the_index_or_mask(chosen):
    tracks = LineTracks.from_lists([np.array([3]), np.array([1, 2]), np.array([0, 4])])
    expected = [tracks[index].tolist() for index in np.arange(3)[chosen]]
    taken = tracks.take(chosen)
    assert [taken[index].tolist() for index in range(len(taken))] == expected


@pytest.mark.parametrize("offsets", [[0, 2, 1, 3], [1, 3], [0, 2], [0, 4], []])
def test_offsets_that_are_no_partition_are_refused(offsets):
    with pytest.raises(ValueError, match="partition"):
        LineTracks(offsets=offsets, observation=[0, 1, 2])


def test_infinite_lines_accept_what_pluecker_makes_of_segments():
    direction, moment = plucker_from_endpoints(SEGMENTS)
    lines = InfiniteLines(direction=direction, moment=moment)
    np.testing.assert_array_equal(lines.take(np.array([1])).direction, direction[1:])
    moved = transform_lines(T_B_A, lines.direction, lines.moment)
    assert len(InfiniteLines(direction=moved[0], moment=moved[1])) == 2
    assert len(InfiniteLines(direction=np.empty((0, 3)), moment=np.empty((0, 3)))) == 0


@pytest.mark.parametrize(
    ("direction", "moment", "named"),
    [
        ([[1.0, 1.0, 0.0]], [[0.0, 0.0, 1.0]], "direction: expected unit"),
        ([[1.0, 0.0, 0.0]], [[0.1, 0.0, 1.0]], "moment: expected vectors normal"),
        ([[1.0, 0.0, 0.0]], [[0.0, np.nan, 1.0]], "moment"),
        ([[1.0, 0.0, 0.0]], np.zeros((2, 3)), "moment"),
    ],
)
def test_numbers_that_are_no_line_are_refused(direction, moment, named):
    with pytest.raises(ValueError, match=named):
        InfiniteLines(direction=direction, moment=moment)
