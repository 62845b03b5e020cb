"""A line map against true surfaces and edges: accuracy, completion, IoU, precision, recall."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import FloatArray
from roel_service.errors import CloudError, MapFileError, MeshError, NoAnswerError
from roel_service.geometry.segments import sample_segments
from roel_service.scene.clouds import PointCloud, TriangleMesh
from roel_service.scene.lines import LineMap

SAMPLE_SPACING_M = 0.005
# 100 km of lines; more is a map in another unit, and would fill the memory.
MAX_SAMPLE_COUNT = 20_000_000


@dataclass(frozen=True, kw_only=True)
class MapEvaluation:
    """How well lines lie on the surfaces, and how much of the edges they cover.

    P are points along the lines, G the true edge points; c_p of P have a point of G within d,
    c_g of G have a point of P within d.

    Attributes:
        accuracy_mm: mean distance of P from the surface.
        completion_mm: mean distance of G from the nearest of P.
        iou_5, iou_10, iou_20: min(c_p, c_g) / (|P| + |G| - max(c_p, c_g)) at d = 5, 10, 20 mm.
        precision_20, recall_20: c_p / |P| and c_g / |G| at d = 20 mm.
        line_count, sample_count, edge_count: lines, |P| and |G|.
        accuracy_median_mm, accuracy_p90_mm: of the distances behind `accuracy_mm`; ghosts far
            from everything move the mean alone.
    """

    accuracy_mm: float
    completion_mm: float
    iou_5: float
    iou_10: float
    iou_20: float
    precision_20: float
    recall_20: float
    line_count: int
    sample_count: int
    edge_count: int
    accuracy_median_mm: float
    accuracy_p90_mm: float


def evaluate_map(line_map: LineMap, mesh: TriangleMesh, edges: PointCloud) -> MapEvaluation:
    """Compare a map with the truth; all in one frame.

    Raises:
        NoAnswerError: the map has no lines.
        MapFileError: its lines are too long to be sampled every 5 mm.
        MeshError, CloudError: no triangles, no edge points.
    """
    if len(line_map) == 0:
        raise NoAnswerError("map", "at least one line", "none", reason="TOO_FEW_LINES")
    return evaluate_points(sample_lines(line_map), mesh, edges, line_count=len(line_map))


def evaluate_points(
    samples: FloatArray, mesh: TriangleMesh, edges: PointCloud, *, line_count: int = 0
) -> MapEvaluation:
    """Compare a map that is made of points with the truth, by the formulas for lines.

    Args:
        samples: (P, 3) m, at least one.
        mesh, edges: the truth, in the same frame.
        line_count: lines that the points stand for.

    Raises:
        MeshError, CloudError: no triangles, no edge points.
    """
    if len(mesh) == 0:
        raise MeshError("mesh", "at least one triangle", "none")
    if len(edges) == 0:
        raise CloudError("edges", "at least one point", "none")
    truth = edges.points.astype(np.float64)
    surface_mm = 1e3 * distances_to_mesh(samples, mesh)
    sample_mm = 1e3 * _nearest_distances(samples, truth)
    edge_mm = 1e3 * _nearest_distances(truth, samples)
    return MapEvaluation(
        accuracy_mm=float(surface_mm.mean()),
        completion_mm=float(edge_mm.mean()),
        iou_5=_iou(sample_mm, edge_mm, 5.0),
        iou_10=_iou(sample_mm, edge_mm, 10.0),
        iou_20=_iou(sample_mm, edge_mm, 20.0),
        precision_20=float((sample_mm <= 20.0).mean()),
        recall_20=float((edge_mm <= 20.0).mean()),
        line_count=line_count,
        sample_count=len(samples),
        edge_count=len(truth),
        accuracy_median_mm=float(np.median(surface_mm)),
        accuracy_p90_mm=float(np.percentile(surface_mm, 90.0)),
    )


def sample_lines(line_map: LineMap, spacing_m: float = SAMPLE_SPACING_M) -> FloatArray:
    """(P, 3) m, equally spaced along each line, both ends included.

    Raises:
        MapFileError: more than `MAX_SAMPLE_COUNT` points.
    """
    with np.errstate(over="ignore"):  # an infinite length is refused like any long one
        lengths_m = line_map.lengths_m
    if (lengths_m / spacing_m).sum() + 2 * len(line_map) > MAX_SAMPLE_COUNT:
        expected = f"lines of at most {MAX_SAMPLE_COUNT * spacing_m:.0f} m together"
        raise MapFileError("map", expected, f"{lengths_m.sum():.0f} m")
    return sample_segments(line_map.segments, spacing_m)[0]


def distances_to_mesh(points: FloatArray, mesh: TriangleMesh) -> FloatArray:
    """(P,) distances of (P, 3) points from the nearest surface, m."""
    import open3d  # seconds to load, so only where a distance is asked for

    # The ray caster knows float32 alone: about the centre of the mesh, it resolves micrometres.
    corners = mesh.triangles.reshape(-1, 3).astype(np.float64)
    centre = (corners.min(axis=0) + corners.max(axis=0)) / 2.0
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(
        open3d.core.Tensor.from_numpy((corners - centre).astype(np.float32)),
        open3d.core.Tensor.from_numpy(np.arange(len(corners), dtype=np.uint32).reshape(-1, 3)),
    )
    queries = open3d.core.Tensor.from_numpy((points - centre).astype(np.float32))
    return np.asarray(scene.compute_distance(queries).numpy(), dtype=np.float64)


def _nearest_distances(points: FloatArray, targets: FloatArray) -> FloatArray:
    """(P,) distances of (P, 3) points from the nearest of (T, 3) targets."""
    distances, _ = cKDTree(targets).query(points)
    return np.asarray(distances)


def _iou(sample_mm: FloatArray, edge_mm: FloatArray, distance_mm: float) -> float:
    near_samples = int((sample_mm <= distance_mm).sum())
    near_edges = int((edge_mm <= distance_mm).sum())
    union = len(sample_mm) + len(edge_mm) - max(near_samples, near_edges)
    return min(near_samples, near_edges) / union
