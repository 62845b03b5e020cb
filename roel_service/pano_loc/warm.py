"""What the first query of a process would wait for, done before its clock starts."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.vectors import unit
from roel_service.pano_loc.arcs import PanoramaArcs, join_arcs
from roel_service.pano_loc.localize import localize_arcs
from roel_service.pano_loc.prepare import prepare_map
from roel_service.scene.lines import LineMap

BOX_SIDES_M = (1.0, 2.0, 3.0)
PLACE_M = (0.1, 0.2, 0.05)


@cache  # once in a process
def warm_up() -> None:
    """Load all loops that a query runs; the first time on a machine they are compiled.

    A picture of nested boxes is located, as a panorama and as a photograph that shows all of it.
    """
    segments = np.concatenate([side_m * _cube() for side_m in BOX_SIDES_M])
    rays = unit(segments - PLACE_M)
    arcs = join_arcs(PanoramaArcs.between(rays[:, 0], rays[:, 1]))
    config = LocalizeConfig()
    maps = [prepare_map(LineMap.from_segments(segments), config)]
    for sides in (np.empty((0, 3)), np.eye(3)):
        localize_arcs(replace(arcs, sides=sides), maps, config)


def _cube() -> FloatArray:
    """(12, 2, 3) edges, about the origin."""
    corners = np.array(list(np.ndindex(2, 2, 2))) - 0.5
    apart = np.abs(corners[:, None] - corners).sum(axis=2)
    return np.asarray(corners[np.argwhere(np.triu(apart == 1.0))])
