from dataclasses import replace

import numpy as np
import pytest

from roel_bench.scenes import HeldBackEvents, LineTruth, MapTruth
from roel_bench.scores import score
from roel_service.errors import InputError
from roel_service.evaluation.maps import evaluate_map, sample_lines
from roel_service.scene.clouds import TriangleMesh
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineMap
from tests.bench.samples import HEIGHT, WIDTH, scene, square, truth

# On the surface of a 4 m square at 2 m, 1 cm beside the true edge.
LINES = LineMap.from_segments(np.array([[[-0.5, 0.01, 2.0], [0.5, 0.01, 2.0]]]))
EDGE = np.stack([np.linspace(-0.5, 0.5, 201), np.zeros(201), np.full(201, 2.0)], axis=1)
KNOWN = truth(square(4.0, 2.0), EDGE)


def test_lines_score_as_the_command_line_says():
    figures = score(scene(truth=KNOWN), LINES)
    evaluation = evaluate_map(LINES, KNOWN.mesh, KNOWN.edges)
    assert figures["iou_20"] == evaluation.iou_20 == 1.0
    assert figures["accuracy_mm"] == evaluation.accuracy_mm
    assert (figures["entity_count"], figures["length_m"]) == (1, 1.0)


def test_points_score_as_the_lines_they_were_taken_from():
    lines = score(scene(truth=KNOWN), LINES)
    points = score(scene(truth=KNOWN), sample_lines(LINES))
    assert points["entity_count"] == lines["sample_count"] == 201
    for name in ("accuracy_mm", "completion_mm", "iou_5", "iou_10", "iou_20", "recall_20"):
        assert points[name] == lines[name]


def test_empty_maps_find_no_edges():
    empty = LineMap.from_segments(np.empty((0, 2, 3)))
    figures = score(scene(truth=KNOWN), empty)
    assert (figures["entity_count"], figures["iou_20"]) == (0, 0.0)
    assert "accuracy_mm" not in figures
    assert score(scene(truth=KNOWN), np.empty((0, 3)))["iou_20"] == 0.0


def test_lines_too_long_to_be_sampled_find_no_edges(caplog):
    endless = LineMap.from_segments(np.array([[[0.0, 0, 0], [1e6, 0, 0]]]))
    figures = score(scene(truth=KNOWN), endless)
    assert (figures["entity_count"], figures["iou_20"]) == (1, 0.0)
    assert "100000 m" in caplog.text


def test_surfaces_alone_give_accuracy_and_precision():
    mesh = TriangleMesh(triangles=square(4.0, 2.0))
    # 7 mm before the surface.
    lines = LineMap.from_segments(LINES.segments - np.array([0, 0, 0.007]))
    figures = score(scene(truth=MapTruth(mesh=mesh, edges=None)), lines)
    assert figures["accuracy_mm"] == pytest.approx(7.0, abs=1e-3)
    assert (figures["surface_precision_5"], figures["surface_precision_10"]) == (0.0, 1.0)
    assert "iou_20" not in figures


def test_true_lines_give_coverage():
    # 24 frames of 0.1 s: the camera moves 0.1 m, and sees about 2 m at 2 m.
    known = LineTruth(segments=LINES.segments)
    assert score(scene(truth=known), LINES)["covered_line_share"] == 1.0
    with pytest.raises(InputError, match="found points"):
        score(scene(truth=known), sample_lines(LINES))


def test_held_back_events_lie_on_the_lines():
    # The camera moves along x, the line too: events lie 0.3 px below its row, or far from it.
    t_us = np.arange(100) * 1000
    on_line = np.arange(100) % 4 != 0
    events = EventStream(
        t_us=t_us,
        x=np.full(100, 31),
        y=np.where(on_line, 24, 40),
        polarity=np.ones(100, int),
        width=WIDTH,
        height=HEIGHT,
    )
    held_back = scene(truth=HeldBackEvents(events=events))
    figures = score(held_back, LINES)
    # 1 cm at 2 m is 0.3 px: the line's row is 23.8.
    assert figures["held_back_explained_share"] == 0.75
    assert figures["held_back_median_px"] == pytest.approx(0.2, abs=1e-6)
    empty = LineMap.from_segments(np.empty((0, 2, 3)))
    assert score(held_back, empty)["held_back_explained_share"] == 0.0


def test_without_truth_only_the_map_itself_is_told():
    figures = score(replace(scene(), truth=None), LINES)
    assert figures == {"entity_count": 1, "length_m": 1.0}
