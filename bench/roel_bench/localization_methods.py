"""The methods that locate panoramas, all asked in the same way."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from roel_bench.localization_places import HOUSE, HOUSE_OUTSIDE, HOUSE_ROOM
from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.fgpl.localize import localize_fgpl, prepare_fgpl
from roel_service.pano_loc.fgpl.parameters import VARIANTS, FgplParameters
from roel_service.pano_loc.hints import PosePrior
from roel_service.pano_loc.localize import localize_panorama
from roel_service.pano_loc.prepare import prepare_map
from roel_service.scene.lines import LineMap

# A first guess is trusted so far.
PRIOR_REACH_M, PRIOR_REACH_RAD = 0.5, float(np.radians(30.0))


@dataclass(frozen=True, eq=False, kw_only=True)
class Answer:
    """What a method says.

    Attributes:
        status: empty where a method has no verdict.
        poses: best first; none where a method says so.
        score, margin: of the best pose, where a method tells.
        covariance: (6, 6) of the best pose, where a method tells.
    """

    status: str
    poses: tuple[SE3, ...]
    score: float | None = None
    margin: float | None = None
    covariance: FloatArray | None = None


# Asks a prepared map for an (H, 2H) uint8 picture, with or without a first guess.
Query = Callable[[Array, SE3 | None], Answer]


@dataclass(frozen=True, kw_only=True)
class Method:
    """A method by name.

    Attributes:
        prepare: what is done once for each map.
        kinds: of the places that it is asked for; empty for all.
    """

    name: str
    prepare: Callable[[LineMap], Query]
    kinds: tuple[str, ...] = ()


def _prepare_default(line_map: LineMap, *, config: LocalizeConfig) -> Query:
    prepared = prepare_map(line_map, config)

    def query(grey: Array, prior: SE3 | None) -> Answer:
        first = (
            None
            if prior is None
            else PosePrior(T_world_picture=prior, reach_m=PRIOR_REACH_M, reach_rad=PRIOR_REACH_RAD)
        )
        result = localize_panorama(grey, [prepared], config, prior=first)
        poses = tuple(item.T_world_panorama for item in result.hypotheses)
        covariance = result.hypotheses[0].covariance if poses else None
        return Answer(
            status=result.status.value,
            poses=poses,
            score=result.score,
            margin=result.margin,
            covariance=covariance,
        )

    return query


def _prepare_fgpl(line_map: LineMap, *, parameters: FgplParameters) -> Query:
    prepared = prepare_fgpl(line_map, parameters, np.random.default_rng(0))

    def query(grey: Array, prior: SE3 | None) -> Answer:
        found = localize_fgpl(grey, [prepared], parameters)
        return Answer(status="", poses=() if found is None else (found.T_world_panorama,))

    return query


# Says its best pose where the default would say that there is none.
UNJUDGED = LocalizeConfig(min_score=0.0, min_coverage=0.0)

METHODS = {
    method.name: method
    for method in (
        Method(name="default", prepare=partial(_prepare_default, config=LocalizeConfig())),
        Method(
            name="default-unjudged",
            prepare=partial(_prepare_default, config=UNJUDGED),
            kinds=(HOUSE, HOUSE_ROOM, HOUSE_OUTSIDE),
        ),
        *(
            Method(name=name, prepare=partial(_prepare_fgpl, parameters=parameters))
            for name, parameters in VARIANTS.items()
        ),
    )
}
