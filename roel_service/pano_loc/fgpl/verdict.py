"""A pose of FGPL with the default's verdict: FGPL has none of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.arcs import detect_arcs
from roel_service.pano_loc.fgpl.localize import FgplMap, localize_fgpl, prepare_fgpl
from roel_service.pano_loc.fgpl.parameters import FgplParameters
from roel_service.pano_loc.prepare import PreparedMap, prepare_map
from roel_service.pano_loc.search import Candidates
from roel_service.pano_loc.verdict import Found, enough_arcs, hypotheses, judge
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PanoLocResult

# Of the choice of a few lines that tell free space from other.
SEED = 0


@dataclass(frozen=True, eq=False, kw_only=True)
class JudgedMap:
    """A map as FGPL asks it, and as the default judges by it."""

    asked: FgplMap
    judging: PreparedMap


def prepare_judged(
    line_map: LineMap, parameters: FgplParameters, config: LocalizeConfig
) -> JudgedMap:
    """Once for each map."""
    asked = prepare_fgpl(line_map, parameters, np.random.default_rng(SEED))
    return JudgedMap(asked=asked, judging=prepare_map(line_map, config))


def localize_judged(
    grey: Array, maps: Sequence[JudgedMap], parameters: FgplParameters, config: LocalizeConfig
) -> PanoLocResult:
    """Where an (H, 2H) uint8 panorama was taken, and whether to rely on it.

    There is one pose to judge, so `AMBIGUOUS` is no answer of this method.

    Args:
        grey: the picture.
        maps: those that may hold the place.
        parameters, config: the same as the maps were prepared with.
    """
    arcs = detect_arcs(grey, config)
    found = localize_fgpl(grey, [item.asked for item in maps], parameters)
    if found is None or not enough_arcs(arcs):
        return judge([], arcs, config)
    pose, judging = found.T_world_panorama, maps[found.map_index].judging
    candidate = Candidates(
        poses=SE3(rotation=pose.rotation[None], translation=pose.translation[None]),
        score=np.zeros(1),
    )
    poses = hypotheses(candidate, arcs, judging, found.map_index)
    return judge([Found(hypotheses=poses, rotation_count=24, candidate_count=1)], arcs, config)
