"""A point cloud made ready for many registrations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.errors import CloudError
from roel_service.geometry.segments import sample_segments
from roel_service.geometry.vectors import unit
from roel_service.register.directions import dominant_directions
from roel_service.register.surfaces import Creases, find_creases, fit_patches, normals_of
from roel_service.register.voting import VotingGrid, voting_grid
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap

# Cells of local planes and of the voting grid, in distances between points.
PATCH_CELLS, VOTING_CELLS = 2.0, 7.5
# The grid has room for a source this large, against the cloud's diagonal.
ROOM_FOR_SOURCE = 1.0
# A point this far from a plane, in distances between points, is none of it.
PLANE_TOLERANCE = 0.6
# Fewer points are no place.
MIN_POINT_COUNT = 100
# Points whose neighbours tell how dense a cloud is.
DENSITY_SAMPLE_COUNT, NEIGHBOUR_COUNT = 2000, 8


@dataclass(frozen=True, eq=False, kw_only=True)
class PreparedCloud:
    """What the solvers look up in a cloud; immutable, so it can be kept and shared.

    Attributes:
        points: (N, 3) m, one for each occupied voxel.
        tree: of the points.
        resolution_m: typical distance of neighbouring points, at least the voxel.
        surface_points, surface_normals: (S, 3) those of the points that lie on local planes.
        surface_tree: of the surface points.
        creases: where local planes meet.
        crease_tree: of the creases; None without any.
        axes: (K, 3) directions that many creases share.
        voting: grid on which shifts are scored.
    """

    points: FloatArray
    tree: cKDTree
    resolution_m: float
    surface_points: FloatArray
    surface_normals: FloatArray
    surface_tree: cKDTree
    creases: Creases
    crease_tree: cKDTree | None
    axes: FloatArray
    voting: VotingGrid

    @property
    def size_bytes(self) -> int:
        """Of memory, about: the trees take as much again as their points."""
        return 2 * sum(array.nbytes for array in self.to_arrays().values()) + self.voting.size_bytes

    def to_arrays(self) -> Mapping[str, Array]:
        """For keeping it: what takes long to find. Trees and grid follow from that."""
        return {
            "points": self.points,
            "resolution_m": np.array(self.resolution_m),
            "surface_points": self.surface_points,
            "surface_normals": self.surface_normals,
            "crease_points": self.creases.points,
            "crease_directions": self.creases.directions,
        }

    @staticmethod
    def from_arrays(arrays: Mapping[str, Array]) -> PreparedCloud:
        """The inverse."""
        return _looked_up(
            points=arrays["points"],
            tree=cKDTree(arrays["points"]),
            resolution_m=float(arrays["resolution_m"]),
            surface_points=arrays["surface_points"],
            surface_normals=arrays["surface_normals"],
            creases=Creases(points=arrays["crease_points"], directions=arrays["crease_directions"]),
        )


def prepare_cloud(cloud: PointCloud, config: RegisterConfig) -> PreparedCloud:
    """Thin a cloud, and find its local planes and creases.

    The planes are fitted to cells as large as the distance of the points asks for, so that a sparse
    scan has some too.

    Raises:
        CloudError: fewer points than `MIN_POINT_COUNT`.
    """
    require_points(cloud)
    points = thin(cloud.points.astype(np.float64), config.voxel_m)
    tree = cKDTree(points)
    resolution_m = max(config.voxel_m, _spacing(points, tree))
    cell_m = PATCH_CELLS * resolution_m
    patches = fit_patches(points, cell_m)
    patch_tree = cKDTree(patches.centres)
    normals, is_flat = normals_of(
        points, patches, patch_tree, cell_m, PLANE_TOLERANCE * resolution_m
    )
    creases = find_creases(patches, patch_tree, tree, cell_m)
    return _looked_up(
        points=points,
        tree=tree,
        resolution_m=resolution_m,
        surface_points=points[is_flat],
        surface_normals=normals[is_flat],
        creases=creases,
    )


def require_points(cloud: PointCloud) -> None:
    """Raise `CloudError` for a cloud of fewer points than `MIN_POINT_COUNT`."""
    if len(cloud) < MIN_POINT_COUNT:
        raise CloudError("cloud", f"at least {MIN_POINT_COUNT} points", f"{len(cloud)}")


def prepare_map(line_map: LineMap, config: RegisterConfig) -> PreparedCloud:
    """A line map as target: its lines are the creases, and there are no surfaces."""
    points, line = sample_segments(line_map.segments, config.voxel_m)
    directions = np.nan_to_num(unit(line_map.segments[:, 1] - line_map.segments[:, 0]))[line]
    nothing = np.empty((0, 3))
    return _looked_up(
        points=points,
        tree=cKDTree(points),
        resolution_m=config.voxel_m,
        surface_points=nothing,
        surface_normals=nothing,
        creases=Creases(points=points, directions=directions),
    )


def _looked_up(
    *,
    points: FloatArray,
    tree: cKDTree,
    resolution_m: float,
    surface_points: FloatArray,
    surface_normals: FloatArray,
    creases: Creases,
) -> PreparedCloud:
    """What was found in a target, with all that makes looking it up fast."""
    axes = dominant_directions(creases.directions, np.ones(len(creases.points)))
    room_m = ROOM_FOR_SOURCE * float(np.linalg.norm(np.ptp(points, axis=0)))
    return PreparedCloud(
        points=points,
        tree=tree,
        resolution_m=resolution_m,
        surface_points=surface_points,
        surface_normals=surface_normals,
        surface_tree=cKDTree(surface_points),
        creases=creases,
        crease_tree=cKDTree(creases.points) if len(creases.points) else None,
        axes=axes,
        voting=voting_grid(points, creases, axes, room_m, VOTING_CELLS * resolution_m),
    )


def thin(points: FloatArray, voxel_m: float) -> FloatArray:
    """(M, 3) means of the points in each occupied voxel; the order of the points plays no part."""
    cells = np.floor((points - points.min(axis=0)) / voxel_m).astype(np.int64)
    sizes = cells.max(axis=0) + 1
    keys = (cells[:, 0] * sizes[1] + cells[:, 1]) * sizes[2] + cells[:, 2]
    order = np.lexsort((*points.T, keys))
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    sums = np.add.reduceat(points[order], starts)
    return np.asarray(sums / np.diff(starts, append=len(points))[:, None])


def _spacing(points: FloatArray, tree: cKDTree) -> float:
    """Side of the square that each point has to itself on a surface, median, m."""
    if len(points) <= NEIGHBOUR_COUNT:
        return 0.0
    some = points[:: max(1, len(points) // DENSITY_SAMPLE_COUNT)]
    distance_m, _ = tree.query(some, k=[NEIGHBOUR_COUNT + 1])
    return float(np.median(distance_m) * np.sqrt(np.pi / NEIGHBOUR_COUNT))
