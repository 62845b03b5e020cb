"""One pose of a panorama in one of a few maps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.fgpl.distance_functions import functions_of_map
from roel_service.pano_loc.fgpl.intersections import (
    Intersections,
    intersections_of_lines,
    without_gaps,
)
from roel_service.pano_loc.fgpl.line_extraction import extract_lines, longest
from roel_service.pano_loc.fgpl.parameters import FgplParameters
from roel_service.pano_loc.fgpl.pose_refinement import Refined, refine_pose
from roel_service.pano_loc.fgpl.pose_search import (
    CoarsePoses,
    PictureLines,
    coarse_pose,
    describe_picture,
    search_poses,
    translation_pool,
)
from roel_service.pano_loc.fgpl.principal_directions import (
    FIELD_LINE_COSINE,
    POINT_LINE_COSINE,
    class_of_lines,
    directions_of_lines,
)
from roel_service.scene.lines import LineMap

# Of the map's lines, few make directions and distance functions, many make intersections.
SPARSE_LENGTH_SHARE, DENSE_LENGTH_M = 0.1, 0.2
MAX_LINE_COUNT = 1000


@dataclass(frozen=True, eq=False, kw_only=True)
class FgplMap:
    """A map with what does not depend on the picture.

    Attributes:
        axes: (3, 3), rows are principal directions, world; not quite at right angles.
        sparse_share, dense_share: of its lines that are kept, and so of a picture's.
        directions: (L, 3) unit, of the lines that intersections are of.
        points: intersections, world.
        places: (T, 3) m, world.
        functions: (T, 642, 6) float32 distance functions, along the axes.
    """

    axes: FloatArray
    sparse_share: float
    dense_share: float
    directions: FloatArray
    points: Intersections
    places: FloatArray
    functions: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class FgplPose:
    """What the method says of a panorama.

    Attributes:
        T_world_panorama: pose.
        coarse: the pose before refinement.
        map_index: which of the maps holds it.
        is_refined: whether the pose is more than the coarse one.
    """

    T_world_panorama: SE3
    coarse: SE3
    map_index: int
    is_refined: bool


def prepare_fgpl(
    line_map: LineMap, parameters: FgplParameters, rng: np.random.Generator
) -> FgplMap:
    """Once for each map."""
    middles = line_map.segments.mean(axis=1)
    ends = line_map.segments.reshape(-1, 3)
    extent_m = float(np.ptp(ends, axis=0).mean()) if len(ends) else 0.0
    sparse = _longer(line_map, SPARSE_LENGTH_SHARE * extent_m)
    dense = _longer(line_map, DENSE_LENGTH_M)
    axes = directions_of_lines(_directions(sparse))
    channel = class_of_lines(_directions(dense), axes, POINT_LINE_COSINE)
    points = intersections_of_lines(dense, channel)
    if parameters.closes_gaps:
        points = without_gaps(points, channel)
    places = translation_pool(middles, parameters.place_count, rng)
    functions = functions_of_map(
        np.ascontiguousarray(sparse @ axes.T),
        class_of_lines(_directions(sparse), axes, FIELD_LINE_COSINE),
        Intersections(points=points.points @ axes.T, pair=points.pair, lines=points.lines),
        places @ axes.T,
        points_by_class=parameters.points_by_class,
    )
    return FgplMap(
        axes=axes,
        sparse_share=len(sparse) / max(len(line_map), 1),
        dense_share=len(dense) / max(len(line_map), 1),
        directions=_directions(dense),
        points=points,
        places=places,
        functions=functions,
    )


def _longer(line_map: LineMap, min_length_m: float) -> FloatArray:
    """(L, 2, 3) m: the longest segments above a length."""
    length_m = line_map.lengths_m
    order = np.argsort(-length_m, kind="stable")[:MAX_LINE_COUNT]
    return np.asarray(line_map.segments[order[length_m[order] > min_length_m]])


def _directions(segments: FloatArray) -> FloatArray:
    return unit(segments[:, 1] - segments[:, 0])


def localize_fgpl(
    grey: Array, maps: Sequence[FgplMap], parameters: FgplParameters
) -> FgplPose | None:
    """The pose of an (H, 2H) uint8 panorama; None where picture or maps hold no lines.

    Args:
        grey: the picture; x forward at its centre, y left, z up.
        maps: those that may hold the place.
        parameters: the same as the maps were prepared with.
    """
    arcs = extract_lines(grey)
    usable = [index for index, item in enumerate(maps) if len(item.places)]
    if len(arcs) == 0 or not usable:
        return None
    picture = _described(arcs, [maps[index] for index in usable], parameters)
    found = [
        (index, search_poses(maps[index].functions, picture.functions, parameters.refined_count))
        for index in usable
    ]
    found.sort(key=lambda item: -item[1].rank)
    refined = [
        (result.loss, index, coarse, result)
        for index, poses in found[: parameters.map_count]
        for coarse, result in _refined(picture, maps[index], poses, parameters)
    ]
    _, index, coarse, best = min(refined, key=lambda item: item[0])
    return FgplPose(
        T_world_panorama=best.pose, coarse=coarse, map_index=index, is_refined=best.is_refined
    )


def _described(
    arcs: PanoramaArcs, maps: Sequence[FgplMap], parameters: FgplParameters
) -> PictureLines:
    """The picture's lines, as many of them as the middle one of the maps keeps of its own."""
    sparse, dense = (
        longest(arcs, sorted(shares)[len(maps) // 2])
        for shares in ([item.sparse_share for item in maps], [item.dense_share for item in maps])
    )
    return describe_picture(sparse, dense, parameters)


def _refined(
    picture: PictureLines, known: FgplMap, poses: CoarsePoses, parameters: FgplParameters
) -> list[tuple[SE3, Refined]]:
    """The coarse poses of a map, and what becomes of them."""
    found = []
    for rotation, place in zip(poses.rotation, poses.place, strict=True):
        R_picture_world = picture.rotations.R_picture_axes[rotation] @ known.axes
        coarse = coarse_pose(R_picture_world, known.places[place])
        result = refine_pose(
            coarse,
            picture.points.relabelled(picture.rotations.pair_of(int(rotation))),
            picture.dense.normals,
            known.points,
            known.directions,
            cost_per_axis=parameters.cost_per_axis,
        )
        found.append((coarse, result))
    return found
