"""Corners at which lines end, as a prior on the depth of lines that are poorly held.

Edges of rooms and furniture end where other edges end. A line seen over a short baseline is where
its cameras see it, at a depth that is hardly known: all lines that come of it by scaling about the
cameras' centre look the same. Where ends of well-held lines lie along the viewing rays of its own
ends, each names a depth. If two or more name the same one, the line is held there, softly. A single
end is not believed: in a picture, edges also end where something nearer hides them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import BoolArray, FloatArray, IntArray
from roel_service.config.stages import Config
from roel_service.geometry.vectors import norm
from roel_service.mapping.directions import direction_prior
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames
from roel_service.mapping.refine import PointPrior, Refined, refine_lines
from roel_service.mapping.trim import ObservedPieces, observed_pieces

# Ends of other lines that must name the same depth.
MIN_WITNESS_COUNT = 2


@dataclass(frozen=True, eq=False, kw_only=True)
class _Corners:
    """Ends of well-held lines: (C, 3) points, m, world, and (C,) the line of each."""

    point: FloatArray
    line: IntArray


@dataclass(frozen=True, eq=False, kw_only=True)
class _Voices:
    """What corners say about the depth of one line.

    Attributes:
        scale: (n,) by which the line would have to be scaled about its cameras to end there.
        end: (n, 3) the end of the line, about its cameras, m.
        witness: (n, 2) which end it is, and the line of the corner; the same two are one voice.
    """

    scale: FloatArray
    end: FloatArray
    witness: IntArray


def held_at_corners(
    refined: Refined, evidence: Evidence, frames: Frames, config: Config
) -> Refined:
    """The lines refined once more, those that are poorly held with the corners that they end at.

    Args:
        refined: lines after their last refinement.
        evidence, frames: of all observations.
        config: `refine`, and `trim` for where lines end.
    """
    if config.refine.corner_sigma_m == 0.0 or len(refined) == 0:
        return refined
    corners = corner_prior(refined, evidence, frames, config)
    if not corners.weight.any():
        return refined
    return refine_lines(
        refined.lines,
        refined.tracks,
        evidence,
        frames,
        config.refine,
        direction_prior(refined, config.refine),
        corners,
    )


def corner_prior(
    refined: Refined, evidence: Evidence, frames: Frames, config: Config
) -> PointPrior:
    """A point that each line should pass through; without weight where no corners agree.

    Args:
        refined: L lines.
        evidence, frames: of all observations.
        config: `refine.corner_*`, and `trim` for where lines end.
    """
    settings = config.refine
    pieces = observed_pieces(refined, evidence.views, frames, config.trim)
    held = pieces.sigma_m <= settings.corner_depth_m
    corners = _Corners(point=pieces.ends[held].reshape(-1, 3), line=np.repeat(pieces.line[held], 2))
    reach = settings.corner_distance_px / frames.focal_px
    point = np.zeros((len(refined), 3))
    weight = np.zeros(len(refined))
    for line in np.unique(pieces.line[~held]):
        own = np.flatnonzero((pieces.line == line) & ~held)
        origin = refined.origin[line]
        voices = _voices(pieces, own, corners, origin, reach)
        agreed = _agreed(voices, settings.corner_depth_m)
        if agreed.any():
            scaled = voices.scale[agreed].mean() * voices.end[agreed].mean(axis=0)
            point[line] = origin + scaled
            weight[line] = (settings.direction_noise_px / settings.corner_sigma_m) ** 2
    return PointPrior(point=point, weight=weight)


def _voices(
    pieces: ObservedPieces, own: IntArray, corners: _Corners, origin: FloatArray, reach: float
) -> _Voices:
    """Corners that lie along the viewing rays of one line's ends.

    Args:
        pieces: of all lines.
        own: those of this line.
        corners: of all lines.
        origin: (3,) the centre of the cameras that see the line, m, world.
        reach: largest distance of a corner from the ray of an end, as a share of its depth.
    """
    ends = (pieces.ends[own] - origin).reshape(-1, 3)
    sigma_m = np.repeat(pieces.sigma_m[own], 2)
    depth_m = norm(ends)
    towards = corners.point - origin
    along_m = towards @ (ends / depth_m[:, None]).T
    beside_m = np.sqrt(np.maximum((towards**2).sum(axis=1)[:, None] - along_m**2, 0.0))
    fits = (
        (beside_m <= reach * along_m)
        & (np.abs(along_m - depth_m) <= sigma_m)
        & (corners.line != pieces.line[own[0]])[:, None]
    )
    corner, end = np.nonzero(fits)
    return _Voices(
        scale=along_m[fits] / depth_m[end],
        end=ends[end],
        witness=np.stack([end, corners.line[corner]], axis=1),
    )


def _agreed(voices: _Voices, tolerance_m: float) -> BoolArray:
    """(n,) the largest group that names one depth; nobody where witnesses are too few."""
    depth_m = norm(voices.end.mean(axis=0)) if len(voices.end) else 0.0
    near = depth_m * np.abs(voices.scale[:, None] - voices.scale) <= tolerance_m
    counts = np.array([len(np.unique(voices.witness[row], axis=0)) for row in near])
    if counts.max(initial=0) < MIN_WITNESS_COUNT:
        return np.zeros(len(near), dtype=bool)
    return np.asarray(near[counts.argmax()])
