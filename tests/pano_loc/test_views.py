import numpy as np
import pytest

from roel_service.geometry.vectors import unit
from roel_service.pano_loc import views_kernels
from roel_service.pano_loc.views import (
    BEYOND_CHANCE,
    BY_LIKELIHOOD,
    CLAIM_BEARING_COUNT,
    agreement,
    best_place,
    class_frames,
    classed_lines,
    pane_of,
    strokes_of,
    views_from,
)
from tests.pano_loc.rooms import pose, seen_from, segments_of

BEARING_COUNT, LINE_COUNT = 360, 1000
TRUTH = pose(1.7, 1.5, 1.4, 0.1, -0.2, 0.7)


@pytest.fixture(scope="module")
def lines():
    segments = segments_of()
    channel = np.abs(segments[:, 1] - segments[:, 0]).argmax(axis=1)
    return classed_lines(segments, channel, class_frames(np.eye(3), np.eye(3)))


def popcount(words):
    return np.bitwise_count(words).astype(int)


def test_frames_of_classes_are_rotations_that_end_in_the_direction():
    shared = unit(np.array([[1.0, 0, 0], [0.6, 0.8, 0], [0, 0.1, 1.0]]))
    frames = class_frames(shared, np.eye(3))
    np.testing.assert_allclose(
        frames @ frames.transpose(0, 2, 1), np.tile(np.eye(3), (3, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(frames), 1.0)
    np.testing.assert_array_equal(frames[:, 2], shared)


def test_an_upright_line_has_one_bearing_and_a_stretch_of_elevations():
    frames = class_frames(np.array([[0.0, 0.0, 1.0]]), np.eye(3))
    line = classed_lines(np.array([[[1.0, 1.0, 0.0], [1.0, 1.0, 2.0]]]), np.zeros(1, int), frames)
    views = views_from(line, np.array([[0.0, 0.0, 1.0], [1.0, 1.0 - 2.5, -3.0]]), BEARING_COUNT, 1)
    x, y = frames[0, :2] @ [1.0, 1.0, 0.0]
    bearing_deg = np.degrees(np.arctan2(y, x)) % 360.0
    assert abs(views.slots[0, 0] + 0.5 - bearing_deg) <= 0.51
    elevation_deg = np.degrees(np.arctan(1.0 / np.sqrt(2.0)))
    assert popcount(views.words[0, 0]) == pytest.approx(
        2 * (elevation_deg + 1.5) / (180 / 64), abs=2
    )
    # Shells by the nearest point: 1.41 m, and the foot 3.9 m away.
    assert views.kinds[:, 0].tolist() == [1, 4]
    assert views.sizes.sum(axis=1).tolist() == popcount(views.words[:, 0]).tolist()


def test_the_fast_angles_are_angles(lines):
    rng = np.random.default_rng(0)
    feet = rng.normal(size=(500, 4))
    feet[:, 3] = feet[:, 2] + np.abs(feet[:, 3])
    which = np.zeros(500, np.int64)
    slots, *_ = views_kernels.views(
        feet, which, np.zeros((1, 1, 3)), np.arange(500)[None], 60_000, 1, np.array([1.0])
    )
    expected = np.arctan2(feet[:, 1], feet[:, 0]) % (2 * np.pi)
    np.testing.assert_allclose((slots[0] + 0.5) * (2 * np.pi / 60_000), expected, atol=8e-5)
    away = np.hypot(feet[:, 0], feet[:, 1])
    expected = np.arctan(feet[:, 3] / away) - np.arctan(feet[:, 2] / away)
    np.testing.assert_allclose(
        views_kernels.spans(feet, which, np.zeros((1, 3))), expected, atol=3e-5
    )


def test_the_true_place_and_orientation_agree_best(lines):
    arcs = seen_from(TRUTH, segments_of())
    half_turn = TRUTH.rotation * np.array([[-1.0], [-1.0], [1.0]])
    rng = np.random.default_rng(0)
    others = rng.uniform([0.3, 0.3, 0.3], [3.7, 2.9, 2.2], (200, 3))
    others = others[np.linalg.norm(others - TRUTH.translation, axis=1) > 0.3]
    views = views_from(
        lines, np.concatenate([TRUTH.translation[None], others]), BEARING_COUNT, LINE_COUNT
    )
    panes = [
        pane_of(strokes_of(arcs, rotation, lines.frames), 0.1, BEARING_COUNT)
        for rotation in (TRUTH.rotation, half_turn)
    ]
    score = np.stack([agreement(views, pane) for pane in panes])
    assert score.shape == (2, len(others) + 1, 2)
    for kind in range(2):
        assert np.unravel_index(score[:, :, kind].argmax(), score.shape[:2]) == (0, 0)


def test_without_arcs_nothing_agrees(lines):
    arcs = seen_from(TRUTH, segments_of()).take(np.arange(0))
    pane = pane_of(strokes_of(arcs, TRUTH.rotation, lines.frames), 0.1, BEARING_COUNT)
    score = agreement(views_from(lines, TRUTH.translation[None], BEARING_COUNT, LINE_COUNT), pane)
    assert (score < 0).all()


def test_the_widest_lines_are_those_that_fill_most_of_the_view(lines):
    inside = lines.frames @ TRUTH.translation
    spans = views_kernels.spans(lines.feet, lines.which, inside)

    def widest(count):
        return views_kernels.widest(lines.feet, lines.which, inside[None], count)[0]

    np.testing.assert_allclose(spans[widest(10)], np.sort(spans)[::-1][:10])
    assert sorted(widest(10**4)) == list(range(len(spans)))
    assert len(widest(0)) == 0


@pytest.mark.parametrize("kind", [BEYOND_CHANCE, BY_LIKELIHOOD])
def test_the_best_of_places_is_that_of_the_best_agreement(lines, kind):
    arcs = seen_from(TRUTH, segments_of())
    pane = pane_of(strokes_of(arcs, TRUTH.rotation, lines.frames), 0.1, BEARING_COUNT)
    places = TRUTH.translation + np.random.default_rng(0).uniform(-0.3, 0.3, (20, 3))
    score = agreement(views_from(lines, places, BEARING_COUNT, LINE_COUNT), pane)[:, kind]
    found = best_place(lines, places, LINE_COUNT, CLAIM_BEARING_COUNT, pane, kind)
    assert found[0] == score.argmax()
    if kind == BEYOND_CHANCE:
        # By likelihood it matters which lines are in front, which is told for the middle alone.
        assert found[1] == pytest.approx(score.max())
