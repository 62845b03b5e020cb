import numpy as np
import pytest

from roel_service.errors import CloudError, MapFileError, MeshError, NoAnswerError
from roel_service.evaluation.maps import (
    distances_to_mesh,
    evaluate_map,
    evaluate_points,
    sample_lines,
)
from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.lines import LineMap

# A square of 4 m in the plane z = 0, as two triangles.
CORNERS = np.array([[-2, -2, 0], [2, -2, 0], [2, 2, 0], [-2, 2, 0]])
SQUARE = TriangleMesh(triangles=CORNERS[[[0, 1, 2], [0, 2, 3]]])

# The ray caster calculates in float32: 4 m have a resolution of 2.4e-7 m.
FLOAT32_MM = 1e-3


def lines(*segments):
    return LineMap.from_segments(np.array(segments, dtype=np.float64))


def edge_points(start, end, count):
    share = np.linspace(0, 1, count)[:, None]
    return PointCloud(points=(1 - share) * np.array(start) + share * np.array(end))


def moved(values, offset):
    return values + np.asarray(offset)


def test_samples_lie_every_5_mm_with_both_ends():
    samples = sample_lines(lines([[0, 0, 0], [1, 0, 0]]))
    assert samples.shape == (201, 3)
    np.testing.assert_allclose(samples[:, 0], np.arange(201) * 0.005, atol=1e-15)  # m, float64
    assert (samples[:, 1:] == 0).all()


@pytest.mark.parametrize(("length_m", "count"), [(0.0, 2), (1e-9, 2), (0.005, 2), (0.0051, 3)])
def test_spacing_divides_the_line_into_equal_steps(length_m, count):
    samples = sample_lines(lines([[1, 2, 3], [1, 2, 3 + length_m]]))
    assert len(samples) == count
    steps = np.diff(samples[:, 2])
    np.testing.assert_allclose(steps, length_m / (count - 1), atol=1e-15)


def test_line_and_its_reverse_have_the_same_samples():
    segment = np.random.default_rng(0).normal(size=(2, 3))
    forward = sample_lines(lines(segment))
    np.testing.assert_allclose(sample_lines(lines(segment[::-1]))[::-1], forward, atol=1e-15)


def test_lines_too_long_to_sample_are_refused():
    for end in (1e6, 1e300):
        with pytest.raises(MapFileError, match="lines of at most 100000 m together"):
            sample_lines(lines([[0, 0, 0], [end, 0, 0]]))


@pytest.mark.parametrize("origin_m", [(0, 0, 0), (3000, -2000, 500)])
def test_distance_is_to_the_surface_and_beyond_its_border_to_the_border(origin_m):
    mesh = TriangleMesh(triangles=moved(SQUARE.triangles, origin_m))
    points = np.array([[0.3, 0.4, 0.02], [0, 0, -1], [2.3, 0, 0.4], [1, 1, 0]])
    # float32 corners are exact here: multiples of 1 m.
    distances = distances_to_mesh(moved(points, origin_m), mesh)
    np.testing.assert_allclose(distances, [0.02, 1, 0.5, 0], rtol=0, atol=1e-6)


def test_perfect_map_has_perfect_scores():
    # As many edge points as samples, on the samples.
    edges = edge_points([0, 0, 0], [1, 0, 0], 201)
    result = evaluate_map(lines([[0, 0, 0], [1, 0, 0]]), SQUARE, edges)
    assert result.accuracy_mm == pytest.approx(0, abs=FLOAT32_MM)
    assert result.completion_mm == pytest.approx(0, abs=FLOAT32_MM)
    assert (result.iou_5, result.iou_10, result.iou_20) == (1, 1, 1)
    assert (result.precision_20, result.recall_20) == (1, 1)
    assert (result.line_count, result.sample_count, result.edge_count) == (1, 201, 201)


def test_line_above_the_plane_is_off_by_its_height():
    edges = edge_points([0, 0, 0], [1, 0, 0], 201)
    result = evaluate_map(lines([[0, 0, 0.007], [1, 0, 0.007]]), SQUARE, edges)
    assert result.accuracy_mm == pytest.approx(7, abs=FLOAT32_MM)
    assert result.accuracy_median_mm == pytest.approx(7, abs=FLOAT32_MM)
    assert result.accuracy_p90_mm == pytest.approx(7, abs=FLOAT32_MM)
    # 7 mm: beyond the first bound, within the others.
    assert result.completion_mm == pytest.approx(7, abs=FLOAT32_MM)
    assert (result.iou_5, result.iou_10, result.iou_20) == (0, 1, 1)


def test_counts_follow_the_formula():
    # Edge points along half the line, 1 mm beside every sample; as many are elsewhere.
    near = edge_points([0.001, 0, 0], [0.501, 0, 0], 101).points
    edges = PointCloud(points=np.concatenate([near, near + np.array([0, 1, 0])]))
    result = evaluate_map(lines([[0, 0, 0], [1, 0, 0]]), SQUARE, edges)
    # Behind 0.501 m one, two and four more samples are within 5, 10 and 20 mm.
    assert result.iou_5 == 101 / (201 + 202 - 102)
    assert result.iou_10 == 101 / (201 + 202 - 103)
    assert result.iou_20 == 101 / (201 + 202 - 105)
    assert result.precision_20 == 105 / 201
    assert result.recall_20 == 0.5


def test_points_on_lines_score_as_the_lines_do():
    line_map = lines([[0, 0, 0.007], [1, 0, 0.007]])
    edges = edge_points([0, 0, 0], [1, 0, 0], 201)
    points = sample_lines(line_map)
    assert evaluate_points(points, SQUARE, edges, line_count=1) == evaluate_map(
        line_map, SQUARE, edges
    )
    assert evaluate_points(points, SQUARE, edges).line_count == 0


def test_ghost_moves_the_mean_and_not_the_median():
    good = [[[0, 0.1 * k, 0.001], [1, 0.1 * k, 0.001]] for k in range(10)]
    ghost = [[0, 0, 1], [1, 0, 1]]
    result = evaluate_map(lines(*good, ghost), SQUARE, edge_points([0, 0, 0], [1, 0, 0], 5))
    assert result.accuracy_median_mm == pytest.approx(1, abs=FLOAT32_MM)
    assert result.accuracy_mm == pytest.approx((10 * 1 + 1000) / 11, abs=FLOAT32_MM)


def test_nothing_to_compare_is_refused():
    line_map = lines([[0, 0, 0], [1, 0, 0]])
    edges = edge_points([0, 0, 0], [1, 0, 0], 5)
    with pytest.raises(NoAnswerError, match="at least one line"):
        evaluate_map(LineMap.from_segments(np.empty((0, 2, 3))), SQUARE, edges)
    with pytest.raises(MeshError):
        evaluate_map(line_map, TriangleMesh(triangles=np.empty((0, 3, 3))), edges)
    with pytest.raises(CloudError):
        evaluate_map(line_map, SQUARE, PointCloud(points=np.empty((0, 3))))
