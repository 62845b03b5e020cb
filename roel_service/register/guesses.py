"""First guesses: rotations from shared directions, shifts by votes.

A rotation that lays two shared directions of the source onto two of the target is off by a degree at
most. Where there are none (no lines in common, one direction only), rotations about the first guess,
or headings all around, take their place.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.register.directions import is_new, matching_rotations
from roel_service.register.prepare import VOTING_CELLS, PreparedCloud
from roel_service.register.source import Samples, Source
from roel_service.register.vertical import Vertical
from roel_service.register.voting import VotingGrid, sharpened, vote, voting_grid

# Samples that vote.
VOTER_COUNT = 1500
# Shifts of each rotation that are kept.
SHIFT_COUNT = 3
# Guesses with fewer votes than this share of the best one's are not followed up.
VOTE_RATIO = 0.5
# Turns about the first guess where nothing else is known.
BLIND_TURN_RAD = np.radians(18.0)
# Headings all around where nothing is known at all.
BLIND_HEADING_COUNT = 36
# Sizes of a source of unknown scale, against that by the extents of both sides.
SCALE_STEPS = 1.05 ** np.arange(-7, 8)


@dataclass(frozen=True, eq=False, kw_only=True)
class Guess:
    """A transform to start from, and the votes for it."""

    T_target_source: SE3
    scale: float
    votes: float


def guesses_near(
    source: Source, target: PreparedCloud, T_init: SE3, config: RegisterConfig
) -> list[Guess]:
    """Guesses within reach of a first one, best first, and that one itself."""
    known = matching_rotations(source.axes, target.axes)
    turns = rotation_angle(known @ T_init.rotation.T) if len(known) else np.empty(0)
    rotations = known[turns <= np.radians(config.reach_deg)]
    if len(rotations) == 0:
        rotations = np.concatenate([T_init.rotation[None], _turned(T_init.rotation)])
    first = Guess(T_target_source=T_init, scale=1.0, votes=0.0)
    return [*_voted(source, target, rotations, config, T_init), first]


def guesses_anywhere(
    source: Source, target: PreparedCloud, config: RegisterConfig, vertical: Vertical | None
) -> list[Guess]:
    """Guesses from nothing, best first; of any rotation if there is no vertical."""
    rotations = matching_rotations(source.axes, target.axes)
    if vertical is not None:
        rotations = _upright(rotations, vertical)
    if len(rotations) == 0:
        angles = np.linspace(0.0, 2.0 * np.pi, BLIND_HEADING_COUNT, endpoint=False)
        rotations = (vertical or Vertical()).turned(np.asarray(angles))
    found = _voted(source, target, rotations, config, None)
    return found or [Guess(T_target_source=SE3.identity(), scale=1.0, votes=0.0)]


def _turned(rotation: FloatArray) -> FloatArray:
    """(6, 3, 3) a rotation turned a little about each axis, both ways."""
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    return np.asarray(rotation_from_vector(BLIND_TURN_RAD * axes) @ rotation)


def _upright(rotations: FloatArray, vertical: Vertical) -> FloatArray:
    """(R, 3, 3) those of the rotations that lay up on up, made to do so exactly."""
    found: list[FloatArray] = []
    for rotation in vertical.turned(vertical.headings_rad(rotations)):
        if is_new(rotation, found):
            found.append(rotation)
    return np.array(found).reshape(-1, 3, 3)


def _voted(
    source: Source,
    target: PreparedCloud,
    rotations: FloatArray,
    config: RegisterConfig,
    T_init: SE3 | None,
) -> list[Guess]:
    """The best shifts of each rotation and scale; near those of a first guess, if there is one."""
    voters = source.votes.at_most(VOTER_COUNT)
    if len(voters) == 0:
        voters = source.samples.at_most(VOTER_COUNT)
    found = []
    for scale in _scales(source, target, config):
        grid = _grid(scale * source.size_m, target)
        for rotation in rotations:
            points, directions = scale * voters.points @ rotation.T, voters.directions @ rotation.T
            allowed = None if T_init is None else _expected(source, rotation, T_init, scale)
            votes = vote(grid, points, directions, SHIFT_COUNT, allowed, config.reach_m)
            for shift, score in zip(votes.shifts, votes.scores, strict=True):
                T = SE3(rotation=rotation, translation=shift)
                found.append(Guess(T_target_source=T, scale=scale, votes=float(score)))
    found.sort(key=lambda guess: -guess.votes)
    few = found[: config.candidate_count]
    return [_sharpened(g, voters, target) for g in few if g.votes >= VOTE_RATIO * found[0].votes]


def _sharpened(guess: Guess, voters: Samples, target: PreparedCloud) -> Guess:
    """The guess with its shift looked at more closely."""
    T = guess.T_target_source
    points, directions = guess.scale * T.rotate(voters.points), T.rotate(voters.directions)
    shift = sharpened(target.voting, points, directions, T.translation)
    return replace(guess, T_target_source=SE3(rotation=T.rotation, translation=shift))


def _scales(source: Source, target: PreparedCloud, config: RegisterConfig) -> list[float]:
    if not config.estimate_scale:
        return [1.0]
    # Of the bulk: a few wild lines make any box large.
    spans = [
        float(np.linalg.norm(np.diff(np.percentile(points, [3.0, 97.0], axis=0), axis=0)))
        for points in (source.samples.points, target.points)
    ]
    return [float(step) for step in SCALE_STEPS * (spans[1] / max(spans[0], 1e-9))]


def _grid(size_m: float, target: PreparedCloud) -> VotingGrid:
    """The target's own grid, or a larger one for a source that it does not hold."""
    if size_m <= target.voting.source_size_m:
        return target.voting
    cell_m = VOTING_CELLS * target.resolution_m
    return voting_grid(target.points, target.creases, target.axes, size_m, cell_m)


def _expected(source: Source, rotation: FloatArray, T_init: SE3, scale: float) -> FloatArray:
    """(2, 3) shifts where the first guess puts the source's origin, and where its middle.

    A guess that is off by a turn may have been turned about either.
    """
    middle = T_init @ (scale * source.centre) - scale * rotation @ source.centre
    return np.stack([T_init.translation, middle])
