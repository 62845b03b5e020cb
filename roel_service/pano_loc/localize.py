"""Where in a map a panorama was taken."""

from __future__ import annotations

from roel_service.arrays import Array
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.arcs import PanoramaArcs, detect_arcs
from roel_service.pano_loc.prepare import PreparedMap
from roel_service.pano_loc.refine import refine_poses
from roel_service.pano_loc.search import coarse_candidates, rotation_hypotheses
from roel_service.pano_loc.verdict import enough_lines, judge, no_answer
from roel_service.scene.results import NoPoseReason, PanoLocResult


def localize_panorama(
    grey: Array, prepared: PreparedMap, config: LocalizeConfig, *, prior: SE3 | None = None
) -> PanoLocResult:
    """Where an (H, 2H) uint8 panorama was taken.

    Args:
        grey: the picture; x forward at its centre, y left, z up.
        prepared: the map.
        config: parameters, the same as the map was prepared with.
        prior: first T_world_panorama; the search stays within 1 m and 30 degrees of it.
    """
    return localize_arcs(detect_arcs(grey, config), prepared, config, prior=prior)


def localize_arcs(
    arcs: PanoramaArcs, prepared: PreparedMap, config: LocalizeConfig, *, prior: SE3 | None = None
) -> PanoLocResult:
    """The same for lines that were found before."""
    if not enough_lines(arcs, prepared):
        return no_answer(NoPoseReason.INSUFFICIENT_LINES, arcs)
    rotations = rotation_hypotheses(arcs, prepared, config, prior)
    if len(rotations) == 0:
        return no_answer(NoPoseReason.DEGENERATE, arcs)
    candidates = coarse_candidates(arcs, prepared, rotations, config, prior)
    refined = refine_poses(candidates, arcs, prepared, config)
    return judge(refined, arcs, prepared, len(rotations), config)
