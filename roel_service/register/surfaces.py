"""Local planes of a cloud, and the creases where two of them meet.

A plane is fitted to every cell with its neighbours; next to a crease that fails, and points there
take the plane of the nearest fitted cell that holds them. Lines of an event map lie where surfaces
meet, and two planes tell where they do far better than the points that happen to lie near.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.geometry.vectors import dot, norm

# A patch is flat if its thickness is this small against its narrower width (variances).
MAX_FLATNESS = 0.15
# and if it is not much thicker than the median one.
MAX_THICKNESS_RATIO = 1.6
# ... and one below this is none, in cells.
MIN_THICKNESS_CELLS = 1e-3
# Patches this near, this alike and this little out of each other's plane are of one plane.
LIKE_CELLS, MIN_LIKE_COSINE, MAX_LIKE_OFFSET_CELLS = 3.0, 0.97, 0.25
WINDOW_STRIDE_CELLS = 1.2
MIN_POINT_COUNT = 6
# Cells around a point of no flat cell whose planes are tried.
CANDIDATE_COUNT = 6
# Two planes make a crease if they meet at more than this.
MIN_CREASE_SINE = 0.42  # 25 degrees
# Creases are looked for between cells this many cells apart, and lie no farther from either.
REACH_CELLS = 4.0
# Directions closer than this (cosine) belong to one crease.
MIN_CREASE_COSINE = 0.97


@dataclass(frozen=True, eq=False, kw_only=True)
class Patches:
    """Flat cells: centres (M, 3) m and unit normals (M, 3)."""

    centres: FloatArray
    normals: FloatArray


@dataclass(frozen=True, eq=False, kw_only=True)
class Creases:
    """Short pieces of lines where two planes meet.

    Attributes:
        points: (C, 3) m.
        directions: (C, 3) unit; the sign means nothing.
    """

    points: FloatArray
    directions: FloatArray


def cell_keys(points: FloatArray, cell_m: float) -> tuple[IntArray, IntArray]:
    """(N,) keys of cubic cells, and (3,) what one step along each axis adds to a key."""
    cells = np.floor((points - points.min(axis=0)) / cell_m).astype(np.int64) + 1
    sizes = cells.max(axis=0) + 2
    strides = np.array([sizes[1] * sizes[2], sizes[2], 1])
    return np.asarray(cells @ strides), strides


def fit_patches(points: FloatArray, cell_m: float) -> Patches:
    """Planes through all cubes of 2 x 2 x 2 cells that are flat, made firmer by their likes."""
    centre = points.mean(axis=0)
    moments = _window_moments(points - centre, cell_m)
    moments = moments[moments[:, 0] >= MIN_POINT_COUNT]
    mean, covariance = _mean_and_covariance(moments)
    values, vectors = np.linalg.eigh(covariance)
    enough = values[:, 0] < MAX_FLATNESS * values[:, 1]
    if not enough.any():
        return Patches(centres=np.empty((0, 3)), normals=np.empty((0, 3)))
    thickness_m = np.sqrt(np.maximum(values[:, 0], 0.0))
    max_m = MAX_THICKNESS_RATIO * np.median(thickness_m[enough])
    # Computed surfaces have no thickness but that of rounding.
    flat = enough & (thickness_m < max(max_m, MIN_THICKNESS_CELLS * cell_m))
    # Neighbouring windows share most of their points: the fullest one of each cell is enough.
    flat = np.flatnonzero(flat)
    flat = flat[np.argsort(-moments[flat, 0], kind="stable")]
    _, first = np.unique(cell_keys(mean[flat], WINDOW_STRIDE_CELLS * cell_m)[0], return_index=True)
    flat = flat[first]
    mean, normals = mean[flat], vectors[flat, :, 0]
    normals, off = _smoothed(mean, normals, moments[flat], cell_m)
    return Patches(centres=mean + off[:, None] * normals + centre, normals=normals)


def _window_moments(points: FloatArray, cell_m: float) -> FloatArray:
    """(W, 10) count, sums and sums of products of the points in each cube of 2 x 2 x 2 cells."""
    keys, strides = cell_keys(points, cell_m)
    order = np.argsort(keys, kind="stable")
    cells, starts = np.unique(keys[order], return_index=True)
    p = points[order]
    terms = np.concatenate([np.ones((len(p), 1)), p, p[:, _ROWS] * p[:, _COLUMNS]], axis=1)
    own = np.add.reduceat(terms, starts)
    windows = np.unique((cells[:, None] + _WINDOW @ strides).ravel())
    moments = np.zeros((len(windows), 10))
    for step in _WINDOW @ strides:
        moments[np.searchsorted(windows, cells + step)] += own
    return moments


def _mean_and_covariance(moments: FloatArray) -> tuple[FloatArray, FloatArray]:
    mean = moments[:, 1:4] / moments[:, :1]
    second = (moments[:, 4:] / moments[:, :1])[:, _UNPACK]
    return mean, np.asarray(second - mean[:, :, None] * mean[:, None, :])


def _smoothed(
    centres: FloatArray, normals: FloatArray, moments: FloatArray, cell_m: float
) -> tuple[FloatArray, FloatArray]:
    """Normals through all patches near by that lie in the same plane, and the planes' offsets."""
    pairs = cKDTree(centres).query_pairs(LIKE_CELLS * cell_m, output_type="ndarray")
    first, second = pairs.T
    between = centres[second] - centres[first]
    bound = MAX_LIKE_OFFSET_CELLS * cell_m
    like = np.abs(dot(normals[first], normals[second])) > MIN_LIKE_COSINE
    like &= np.abs(dot(normals[first], between)) < bound
    like &= np.abs(dot(normals[second], between)) < bound
    first, second = first[like], second[like]
    pooled = moments.copy()
    for column in range(moments.shape[1]):
        for a, b in ((first, second), (second, first)):
            pooled[:, column] += np.bincount(a, moments[b, column], len(moments))
    mean, covariance = _mean_and_covariance(pooled)
    normals = np.linalg.eigh(covariance)[1][..., 0]
    return normals, dot(normals, mean - centres)


_WINDOW = np.stack(np.meshgrid(*[[0, -1]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
_ROWS, _COLUMNS = np.triu_indices(3)
_UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


def normals_of(
    points: FloatArray, patches: Patches, tree: cKDTree, cell_m: float, tolerance_m: float
) -> tuple[FloatArray, BoolArray]:
    """(N, 3) normals of the patches that hold the points, and (N,) whether one does."""
    if len(patches.centres) == 0:
        return np.zeros_like(points), np.zeros(len(points), np.bool_)
    reach_m = REACH_CELLS * cell_m
    near, is_held = _holding(points, patches, tree, 1, reach_m, tolerance_m)
    # Most points lie on the nearest patch; of the others the next ones are looked at.
    left = np.flatnonzero(~is_held)
    near[left], is_held[left] = _holding(
        points[left], patches, tree, CANDIDATE_COUNT, reach_m, tolerance_m
    )
    return patches.normals[near], is_held


def _holding(
    points: FloatArray,
    patches: Patches,
    tree: cKDTree,
    count: int,
    reach_m: float,
    tolerance_m: float,
) -> tuple[IntArray, BoolArray]:
    """(N,) of so many patches near each point the nearest whose plane holds it, and whether one does."""
    numbers = list(range(1, count + 1))
    distance, near = tree.query(points, k=numbers, distance_upper_bound=reach_m)
    known = np.isfinite(distance)
    near = np.where(known, near, 0)
    off = np.abs(dot(patches.normals[near], points[:, None] - patches.centres[near]))
    holds = known & (off < tolerance_m)
    first = np.argmax(holds, axis=1)
    return near[np.arange(len(points)), first], holds.any(axis=1)


def find_creases(patches: Patches, tree: cKDTree, points: cKDTree, cell_m: float) -> Creases:
    """Where planes of patches near one another meet, with points of the cloud there."""
    pairs = tree.query_pairs(REACH_CELLS * cell_m, output_type="ndarray")
    if len(pairs) == 0:
        return _merged(np.empty((0, 3)), np.empty((0, 3)), cell_m)
    n1, n2 = patches.normals[pairs].transpose(1, 0, 2)
    direction = np.cross(n1, n2)
    sine = norm(direction)
    steep = sine > MIN_CREASE_SINE
    pairs, n1, n2 = pairs[steep], n1[steep], n2[steep]
    direction = direction[steep] / sine[steep, None]
    c1, c2 = patches.centres[pairs].transpose(1, 0, 2)
    # The point of both planes that is nearest to the middle of the two patches.
    middle = 0.5 * (c1 + c2)
    rows = np.stack([n1, n2, direction], axis=1)
    right = np.stack([dot(n1, c1 - middle), dot(n2, c2 - middle), np.zeros(len(pairs))], axis=1)
    points_on = middle + np.linalg.solve(rows, right[..., None])[..., 0]
    reach_m = REACH_CELLS * cell_m
    near = np.maximum(norm(points_on - c1), norm(points_on - c2)) < reach_m
    # Planes that would meet behind a gap make no edge.
    gap_m, _ = points.query(points_on[near], distance_upper_bound=cell_m)
    kept = np.flatnonzero(near)[gap_m < 0.6 * cell_m]
    return _merged(points_on[kept], direction[kept], 0.5 * cell_m)


def _merged(points: FloatArray, directions: FloatArray, cell_m: float) -> Creases:
    """One crease for each cell and main axis: medians of many are firmer than any of them."""
    if len(points) == 0:
        return Creases(points=np.empty((0, 3)), directions=np.empty((0, 3)))
    axis = np.argmax(np.abs(directions), axis=1)
    sign = np.sign(directions[np.arange(len(axis)), axis])
    directions = directions * sign[:, None]
    keys, _ = cell_keys(points, cell_m)
    _, inverse, counts = np.unique(3 * keys + axis, return_inverse=True, return_counts=True)
    order = np.argsort(inverse, kind="stable")
    starts = np.cumsum(counts) - counts
    mean_points = np.add.reduceat(points[order], starts) / counts[:, None]
    sums = np.add.reduceat(directions[order], starts) / counts[:, None]
    # Cells in which different creases cross have no direction in common.
    clear = norm(sums) > MIN_CREASE_COSINE
    return Creases(points=mean_points[clear], directions=sums[clear] / norm(sums[clear])[:, None])
