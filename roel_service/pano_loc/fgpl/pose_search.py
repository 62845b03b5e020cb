"""Coarse poses: 24 rotations by principal directions, and a pool of translations."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.fgpl import distance_kernels
from roel_service.pano_loc.fgpl.distance_functions import functions_of_picture, query_rays
from roel_service.pano_loc.fgpl.intersections import Intersections, intersections_of_arcs
from roel_service.pano_loc.fgpl.parameters import FgplParameters
from roel_service.pano_loc.fgpl.principal_directions import (
    FIELD_ARC_SINE,
    POINT_ARC_SINE,
    class_of_arcs,
    directions_of_arcs,
    nearest_points,
)

# Coordinates of the pool lie within these quantiles, evenly if there are this many of them.
QUANTILES = (0.1, 0.9)
MANY_COORDINATES = 10
MIN_EXTENT_SHARE = 0.02
# Places this close to one of a hundredth of the lines' middles are no free space.
MIN_DISTANCE_M = 0.3
SAMPLED_SHARE = 0.01
# Maps are compared by the mean over so many of their best poses.
RANKED_COUNT = 5


def translation_pool(middles: FloatArray, count: int, rng: np.random.Generator) -> FloatArray:
    """(T, 3) m: about that many places among (L, 3) middles of lines."""
    low, high = np.quantile(middles, QUANTILES, axis=0)
    # A map in a plane would ask for endless places along it.
    extent = np.maximum(high - low, max(MIN_EXTENT_SHARE * np.max(high - low), 1e-6))
    axes = []
    for axis in range(3):
        others = extent[(axis + 1) % 3] * extent[(axis + 2) % 3]
        number = int(np.ceil((extent[axis] ** 2 * count / others) ** (1 / 3)))
        number -= 1 - number % 2
        shares = (np.arange(number) + 1) / (number + 1)
        if number >= MANY_COORDINATES:
            shares = np.linspace(*QUANTILES, number)
        axes.append(np.quantile(middles[:, axis], shares))
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    sampled = rng.permutation(middles)[: int(SAMPLED_SHARE * len(middles))]
    if len(sampled) == 0:
        return places
    distance_m = np.linalg.norm(places[:, None] - sampled, axis=2).min(axis=1)
    return np.asarray(places[distance_m > MIN_DISTANCE_M])


@dataclass(frozen=True, eq=False, kw_only=True)
class Rotations:
    """The ways to call a picture's principal directions x, y and z.

    Attributes:
        R_picture_axes: (24, 3, 3).
        order: (24, 3) which of the picture's directions each axis is.
    """

    R_picture_axes: FloatArray
    order: IntArray

    def pair_of(self, index: int) -> Array:
        """(3,) which pair of axes each pair of the picture's directions is."""
        axis = np.argsort(self.order[index])
        first, second = axis, np.roll(axis, -1)
        # Pair k has the axes k and k + 1, in either order.
        return np.where((first + 1) % 3 == second, first, second)


def rotation_candidates(directions: FloatArray) -> Rotations:
    """All proper rotations that lay axes on (3, 3) principal directions, with either sign."""
    rotations, orders = [], []
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            target = (np.array(signs)[:, None] * directions[list(order)]).T
            if np.linalg.det(target) <= 0:
                continue
            U, _, Vt = np.linalg.svd(target)
            rotations.append(U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt)
            orders.append(order)
    return Rotations(R_picture_axes=np.array(rotations), order=np.array(orders))


@dataclass(frozen=True, eq=False, kw_only=True)
class PictureLines:
    """What is known of a picture before it is looked for.

    Attributes:
        dense: arcs for intersections and refinement.
        points: where they meet, by pairs of the picture's directions.
        rotations: that may be.
        functions: (24, 642, 6) float32 distance functions, turned.
    """

    dense: PanoramaArcs
    points: Intersections
    rotations: Rotations
    functions: Array


def describe_picture(
    sparse: PanoramaArcs, dense: PanoramaArcs, parameters: FgplParameters
) -> PictureLines:
    """Directions and distance functions by few arcs, intersections by many."""
    directions = directions_of_arcs(sparse.normals)
    rotations = rotation_candidates(directions)
    points = intersections_of_arcs(dense, class_of_arcs(dense.normals, directions, POINT_ARC_SINE))
    first = rotations.R_picture_axes[0]
    functions = functions_of_picture(
        sparse,
        class_of_arcs(sparse.normals, first.T, FIELD_ARC_SINE),
        points,
        first,
        points_by_class=parameters.points_by_class,
    )
    return PictureLines(
        dense=dense,
        points=points,
        rotations=rotations,
        functions=_turned(functions, rotations, points_by_class=parameters.points_by_class),
    )


def _turned(functions: Array, rotations: Rotations, *, points_by_class: bool) -> Array:
    """(24, 642, 6) values of the first rotation's functions at the nearest rays of every other."""
    turned = []
    for index, R in enumerate(rotations.R_picture_axes):
        relative = rotations.R_picture_axes[0].T @ R
        nearest = nearest_points(query_rays() @ relative.T, query_rays())
        lines = rotations.order[index]
        points = lines if points_by_class else np.argsort(rotations.pair_of(index))
        turned.append(functions[nearest][:, [*lines, *(3 + points)]])
    return np.array(turned)


@dataclass(frozen=True, eq=False, kw_only=True)
class CoarsePoses:
    """The best poses of a map.

    Attributes:
        rotation, place: (N,) indices, best first.
        rank: mean agreement of the best, for the choice of maps.
    """

    rotation: IntArray
    place: IntArray
    rank: float


def search_poses(of_map: Array, of_picture: Array, count: int) -> CoarsePoses:
    """The pairs of place and rotation whose functions agree most.

    Args:
        of_map: (T, 642, 6).
        of_picture: (24, 642, 6).
        count: poses to keep.
    """
    score = distance_kernels.agreement(
        of_map.reshape(len(of_map), -1), of_picture.reshape(len(of_picture), -1)
    )
    order = np.argsort(-score.ravel(), kind="stable")
    place, rotation = np.divmod(order[:count], len(of_picture))
    return CoarsePoses(
        rotation=rotation, place=place, rank=float(score.ravel()[order[:RANKED_COUNT]].mean())
    )


def coarse_pose(R_picture_world: FloatArray, place: FloatArray) -> SE3:
    """T_world_picture; a rotation that the map's skewed directions bent is straightened."""
    U, _, Vt = np.linalg.svd(R_picture_world)
    return SE3(rotation=(U @ Vt).T, translation=place)
