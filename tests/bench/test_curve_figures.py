import numpy as np

from roel_bench.curve_figures import curve_figures

# Ten points of a straight edge and ten of a round one, half a metre apart, 1 cm from point to point.
STRAIGHT = np.column_stack([0.01 * np.arange(10), np.zeros(10), np.zeros(10)])
CURVED = STRAIGHT + np.array([0.0, 0.5, 0.0])
EDGES = np.concatenate([STRAIGHT, CURVED]).astype(np.float32)


def figures(samples):
    return curve_figures(np.asarray(samples), EDGES, EDGES[10:])


def test_a_map_of_the_straight_edge_covers_nothing_round():
    found = figures(STRAIGHT)
    assert found["curved_recall_20"] == 0.0
    assert found["straight_recall_20"] == 1.0
    assert found["curved_sample_count"] == 0
    assert found["curved_precision_20"] is None
    assert found["curved_offset_median_mm"] is None
    assert found["curved_completion_mm"] == 500.0


def test_points_beside_a_round_edge_are_measured_against_it():
    found = figures(CURVED[:5] + np.array([0.0, 0.0, 0.008]))
    assert found["curved_edge_count"] == 10
    assert found["curved_sample_count"] == 5
    np.testing.assert_allclose(found["curved_offset_median_mm"], 8.0, rtol=1e-4)
    assert found["curved_precision_5"] == 0.0
    assert found["curved_precision_10"] == 1.0
    # Five of them, and one that is 12.8 mm from the last of the map's.
    assert found["curved_recall_10"] == 0.5
    assert found["curved_recall_20"] == 0.6


def test_ghosts_far_from_every_edge_are_no_points_of_round_edges():
    assert figures(CURVED + np.array([0.0, 0.3, 0.0]))["curved_sample_count"] == 0
