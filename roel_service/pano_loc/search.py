"""Coarse poses: for every orientation the places that look most like the picture."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry.se3 import SE3
from roel_service.geometry.vectors import norm
from roel_service.pano_loc.arcs import PanoramaArcs
from roel_service.pano_loc.hints import PosePrior
from roel_service.pano_loc.prepare import BEARING_COUNT, VIEW_LINE_COUNT, PreparedMap
from roel_service.pano_loc.side_by_side import side_by_side
from roel_service.pano_loc.views import (
    BEYOND_CHANCE,
    BY_LIKELIHOOD,
    CLAIM_BEARING_COUNT,
    Strokes,
    agreement,
    best_place,
    pane_of,
    strokes_of,
    views_from,
)

# Places within reach of a prior are tried at this spacing, and so much fewer candidates stay.
PRIOR_STEP_M, PRIOR_CANDIDATE_SHARE = 0.25, 1 / 3
# Maps of more places, which hold many rooms, have more candidates in proportion.
ROOM_PLACE_COUNT = 4000
# In each orientation and by each ranking these places stay after the widest lines: a share, and no
# fewer than so many.
OUTLINED_SHARE, MIN_OUTLINED_COUNT = 0.06, 150
# Places of one orientation, so far apart.
PLACES_PER_ROTATION = 6
SUPPRESSION_M = 0.5
CONSIDERED_PLACE_COUNT = 60
RANKINGS = (BEYOND_CHANCE, BY_LIKELIHOOD)
# Rounds around the best: the share of the candidates that takes part, how much finer the grid is, and
# in how many bearings a line hides others: few where lines are to tell the place exactly.
ROUNDS = ((1.0, 3, CLAIM_BEARING_COUNT), (0.35, 3, CLAIM_BEARING_COUNT), (0.35, 9, 1))
FINE_LINE_COUNT, FINE_BEARING_COUNT = 300, 360


@dataclass(frozen=True, eq=False, kw_only=True)
class Candidates:
    """Poses that might be the answer, best first.

    Attributes:
        poses: T_world_panorama (C).
        score: (C,), comparable within one set alone.
    """

    poses: SE3
    score: FloatArray

    def __len__(self) -> int:
        return len(self.score)

    def take(self, index: Array) -> Candidates:
        """The candidates of these indices, or of this mask, in that order."""
        return Candidates(poses=self.poses[index], score=self.score[index])

    def joined(self, other: Candidates) -> Candidates:
        """These and others."""
        return Candidates(
            poses=SE3(
                rotation=np.concatenate([self.poses.rotation, other.poses.rotation]),
                translation=np.concatenate([self.poses.translation, other.poses.translation]),
            ),
            score=np.concatenate([self.score, other.score]),
        )

    def ranked(self) -> Candidates:
        """Best first."""
        return self.take(np.argsort(-self.score, kind="stable"))


@dataclass(frozen=True, eq=False, kw_only=True)
class _Seeds:
    """Places in orientations, before they are poses.

    Attributes:
        rotation: (C,) index of the orientation.
        places: (C, 3) m.
        score: (C,).
    """

    rotation: IntArray
    places: FloatArray
    score: FloatArray

    def best(self, count: int) -> _Seeds:
        """The best ones, best first."""
        order = np.argsort(-self.score, kind="stable")[:count]
        return _Seeds(
            rotation=self.rotation[order], places=self.places[order], score=self.score[order]
        )


def coarse_candidates(
    arcs: PanoramaArcs,
    prepared: PreparedMap,
    rotations: FloatArray,
    config: LocalizeConfig,
    prior: PosePrior | None = None,
) -> Candidates:
    """Places that agree best with the picture in each orientation, made finer in rounds.

    Everything is ranked twice: where all lines can be seen, and where walls hide most of them. With
    a prior, places within its reach are tried.
    """
    candidate_count = config.candidate_count / len(RANKINGS)
    frames = prepared.lines.frames
    strokes = side_by_side(lambda rotation: strokes_of(arcs, rotation, frames), rotations)
    if prior is None:
        step_m = prepared.step_m
        candidate_count *= max(1.0, len(prepared.places) / ROOM_PLACE_COUNT)
        places, scores = _everywhere(prepared, strokes)
    else:
        step_m = PRIOR_STEP_M
        candidate_count *= PRIOR_CANDIDATE_SHARE
        places, scores = _within_reach(prepared, strokes, prior)
    found = []
    for kind in RANKINGS:
        seeds = _best_of_all(places, scores[:, :, kind])
        for share, finer, claim_bearing_count in ROUNDS:
            seeds = seeds.best(max(1, round(share * candidate_count)))
            seeds = _moved(seeds, kind, prepared, strokes, step_m / finer, claim_bearing_count)
        found.append(seeds)
    rotation = np.concatenate([seeds.rotation for seeds in found])
    poses = SE3(
        rotation=rotations[rotation],
        translation=np.concatenate([seeds.places for seeds in found]),
    )
    return Candidates(poses=poses, score=np.concatenate([_ranks(seeds.score) for seeds in found]))


def _everywhere(prepared: PreparedMap, strokes: Sequence[Strokes]) -> tuple[FloatArray, FloatArray]:
    """(R, C, 3) places that agree best with the widest lines, and their (R, C, 2) `agreement`."""
    count = max(MIN_OUTLINED_COUNT, round(OUTLINED_SHARE * len(prepared.places)))
    count = min(count, len(prepared.places))

    def outlined(turned: Strokes) -> tuple[FloatArray, FloatArray]:
        pane = pane_of(turned, prepared.step_m, BEARING_COUNT)
        outline = agreement(prepared.outline, pane)
        chosen = np.argpartition(-outline, count - 1, axis=0)[:count].ravel()
        return prepared.places[chosen], agreement(prepared.views, pane, chosen)

    places, scores = zip(*side_by_side(outlined, strokes), strict=True)
    return np.stack(places), np.stack(scores)


def _within_reach(
    prepared: PreparedMap, strokes: Sequence[Strokes], prior: PosePrior
) -> tuple[FloatArray, FloatArray]:
    """(R, C, 3) places near a first one, and their (R, C, 2) `agreement`."""
    places = _ball(prior.reach_m, PRIOR_STEP_M) + prior.T_world_picture.translation
    views = views_from(prepared.lines, places, BEARING_COUNT, VIEW_LINE_COUNT)
    panes = [pane_of(turned, PRIOR_STEP_M, BEARING_COUNT) for turned in strokes]
    scores = np.stack([agreement(views, pane) for pane in panes])
    return np.broadcast_to(places, (len(strokes), *places.shape)), scores


def _ranks(score: FloatArray) -> FloatArray:
    """1 for the best, less for the others: makes the two scores comparable."""
    rank = np.empty(len(score))
    rank[np.argsort(-score, kind="stable")] = np.arange(len(score))
    return 1.0 / (1.0 + rank)


def _best_of_all(places: FloatArray, scores: FloatArray) -> _Seeds:
    """The best places for each orientation, from (R, C, 3) places and (R, C) scores."""
    chosen = [_best_apart(*item) for item in zip(places, scores, strict=True)]
    rotation = np.repeat(np.arange(len(scores)), [len(item) for item in chosen])
    place = np.concatenate([np.array(item, dtype=np.int64) for item in chosen])
    return _Seeds(rotation=rotation, places=places[rotation, place], score=scores[rotation, place])


def _best_apart(places: FloatArray, score: FloatArray) -> list[int]:
    """Indices of the best places, each apart from the better ones."""
    left = np.argsort(-score, kind="stable")[:CONSIDERED_PLACE_COUNT]
    kept: list[int] = []
    while len(left) and len(kept) < PLACES_PER_ROTATION:
        kept.append(int(left[0]))
        left = left[norm(places[left] - places[left[0]]) >= SUPPRESSION_M]
    return kept


def _moved(
    seeds: _Seeds,
    kind: int,
    prepared: PreparedMap,
    strokes: Sequence[Strokes],
    step_m: float,
    claim_bearing_count: int,
) -> _Seeds:
    """Each at the best place of a finer grid around it, as one of the two scores says."""
    axis = step_m * np.array([-1.0, 0.0, 1.0])
    around = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3) @ prepared.frame
    panes = {
        rotation: pane_of(strokes[rotation], step_m, FINE_BEARING_COUNT)
        for rotation in np.unique(seeds.rotation)
    }

    def moved(member: int) -> tuple[FloatArray, float]:
        places = seeds.places[member] + around
        pane = panes[seeds.rotation[member]]
        best, score = best_place(
            prepared.lines, places, FINE_LINE_COUNT, claim_bearing_count, pane, kind
        )
        return places[best], score

    places, scores = zip(*side_by_side(moved, range(len(seeds.score))), strict=True)
    return _Seeds(rotation=seeds.rotation, places=np.stack(places), score=np.array(scores))


def _ball(radius_m: float, step_m: float) -> FloatArray:
    """(T, 3) points of a grid within a radius of zero."""
    axis = np.arange(-np.floor(radius_m / step_m), radius_m / step_m + 0.5) * step_m
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    return np.asarray(grid[np.linalg.norm(grid, axis=1) <= radius_m])
