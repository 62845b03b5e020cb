"""Where in one of a few maps a picture was taken."""

from __future__ import annotations

from collections.abc import Sequence

from roel_service.arrays import Array
from roel_service.config.stages import LocalizeConfig
from roel_service.errors import InputError
from roel_service.pano_loc.arcs import PanoramaArcs, detect_arcs
from roel_service.pano_loc.hints import MAX_MAP_COUNT, Gravity, PosePrior
from roel_service.pano_loc.orientation import rotation_hypotheses
from roel_service.pano_loc.photograph import arcs_of_photograph
from roel_service.pano_loc.prepare import PreparedMap
from roel_service.pano_loc.refine import refine_poses
from roel_service.pano_loc.search import coarse_candidates
from roel_service.pano_loc.verdict import Found, enough_arcs, enough_lines, hypotheses, judge
from roel_service.scene.camera import Camera
from roel_service.scene.results import PanoLocResult


def localize_panorama(
    grey: Array,
    maps: Sequence[PreparedMap],
    config: LocalizeConfig,
    *,
    prior: PosePrior | None = None,
    gravity: Gravity | None = None,
) -> PanoLocResult:
    """Where an (H, 2H) uint8 panorama was taken.

    Args:
        grey: the picture; x forward at its centre, y left, z up.
        maps: 1 to 8, any of which may hold the place.
        config: parameters, the same as the maps were prepared with.
        prior: first pose; the search stays within its reach, in every map.
        gravity: which way is up; orientations that disagree are not tried.

    Raises:
        InputError: no map, or more than 8.
    """
    return localize_arcs(detect_arcs(grey, config), maps, config, prior=prior, gravity=gravity)


def localize_photograph(
    grey: Array,
    camera: Camera,
    maps: Sequence[PreparedMap],
    config: LocalizeConfig,
    *,
    prior: PosePrior,
    gravity: Gravity | None = None,
) -> PanoLocResult:
    """Where an (H, W) uint8 photograph was taken; the poses are `T_world_camera`.

    Args:
        grey: the picture.
        camera: that took it, its axes right, down, forward.
        maps: as in `localize_panorama`.
        config: parameters, the same as the maps were prepared with.
        prior: first T_world_camera: a photograph shows too little to be looked for everywhere.
        gravity: which way is up; `up_picture` in the camera's axes.

    Raises:
        InputError: as `localize_panorama`, or a picture of another size than the camera's.
    """
    arcs = arcs_of_photograph(grey, camera, config)
    return localize_arcs(arcs, maps, config, prior=prior, gravity=gravity)


def localize_arcs(
    arcs: PanoramaArcs,
    maps: Sequence[PreparedMap],
    config: LocalizeConfig,
    *,
    prior: PosePrior | None = None,
    gravity: Gravity | None = None,
) -> PanoLocResult:
    """The same for lines that were found before."""
    if not 1 <= len(maps) <= MAX_MAP_COUNT:
        raise InputError("maps", f"1 to {MAX_MAP_COUNT} maps", f"{len(maps)}")
    found = [
        _searched(arcs, prepared, index, config, prior, gravity)
        for index, prepared in enumerate(maps)
        if enough_arcs(arcs) and enough_lines(prepared)
    ]
    return judge(found, arcs, config)


def _searched(
    arcs: PanoramaArcs,
    prepared: PreparedMap,
    map_index: int,
    config: LocalizeConfig,
    prior: PosePrior | None,
    gravity: Gravity | None,
) -> Found:
    """The best poses in one map."""
    rotations = rotation_hypotheses(arcs, prepared, config, prior, gravity)
    if len(rotations) == 0:
        return Found(hypotheses=(), rotation_count=0, candidate_count=0)
    candidates = coarse_candidates(arcs, prepared, rotations, config, prior)
    refined = refine_poses(candidates, arcs, prepared, has_prior=prior is not None)
    if prior is not None:
        refined = refined.take(prior.holds(refined.poses))
    return Found(
        hypotheses=hypotheses(refined, arcs, prepared, map_index),
        rotation_count=len(rotations),
        candidate_count=len(candidates),
    )
