"""Directions that many lines of a scene share, as a prior on the lines that are poorly held.

Most edges of a building or of a piece of furniture run along a few directions. A line seen over a
short baseline, such as a horizontal edge under horizontal motion, is well held across its viewing
planes and poorly within them: its direction lies somewhere on a short arc. Where the arcs of many
lines meet there is a common direction, and the lines whose arc passes through it are pulled to it,
softly. Nothing is assumed about how many directions there are, nor about the angles between them.

The idea is that of vanishing directions (Barnard, 1983) and of the Manhattan frames mixture
(Straub et al., 2014), with the uncertainty of every line in place of its residual in an image.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import RefineRoundsConfig
from roel_service.geometry.vectors import unit
from roel_service.in_order import in_order
from roel_service.mapping import directions_kernels
from roel_service.mapping.directions_kernels import MIN_COSINE
from roel_service.mapping.refine import DirectionPrior, Refined

# Lines whose direction is less certain than this say nothing about common directions.
MAX_SPREAD_RAD = np.deg2rad(15.0)
# Density of directions at which a line counts half, per steradian: what a line that may point
# anywhere within some 40 degrees would give.
BACKGROUND_DENSITY = 3.0
# A common direction has at least so many lines, in number and as a share of all.
MIN_LINE_COUNT = 6.0
MIN_LINE_SHARE = 0.04
# ... and more than arcs that cross by chance would give, in standard deviations of their number:
# the best of some thousand candidates is not to pass.
CHANCE_DEVIATIONS = 6.0
MAX_DIRECTION_COUNT = 8
# Candidates are the directions of this many lines, the most certain ones, and where the arcs of
# this many cross.
CANDIDATE_LINE_COUNT = 300
PAIRED_LINE_COUNT = 60
CANDIDATE_BLOCK_COUNT = 64
MEAN_SHIFT_COUNT = 10
# A line with this share of its density explained belongs to the direction and votes no more.
EXPLAINED_SHARE = 0.2


@dataclass(frozen=True, eq=False, kw_only=True)
class _UncertainDirections:
    """Directions with their covariance on the sphere.

    Attributes:
        direction: (L, 3) unit vectors.
        precision: (L, 3, 3) inverse covariance in the tangent plane, zero along the direction.
        peak: (L,) largest density, per steradian.
        spread_rad: (L,) standard deviation along the longer axis.
        axis: (L, 3) unit normal of the great circle along the longer axis.
    """

    direction: FloatArray
    precision: FloatArray
    peak: FloatArray
    spread_rad: FloatArray
    axis: FloatArray

    def take(self, index: Array) -> _UncertainDirections:
        """The lines of these indices, or of this mask."""
        return _UncertainDirections(**{name: value[index] for name, value in vars(self).items()})

    @property
    def reach(self) -> FloatArray:
        """(L,) share of all directions that each line votes for."""
        # An ellipse in which the density is above the background's, of a half sphere.
        ratio = np.maximum(self.peak / BACKGROUND_DENSITY, 1.0)
        return np.asarray(np.log(ratio) / (2.0 * np.pi * self.peak))

    def squared_distance(self, directions: FloatArray) -> FloatArray:
        """(D, L) squared Mahalanobis distances of (D, 3) directions, infinite far from a line.

        The precision vanishes along the line: the direction's own part across it is all that
        counts, and neither sign matters.
        """
        first, second = np.triu_indices(3)
        outer = directions[:, first] * directions[:, second] * np.where(first == second, 1.0, 2.0)
        squared = outer @ self.precision[:, first, second].T
        cosine = directions @ self.direction.T
        return np.asarray(np.where(np.abs(cosine) > MIN_COSINE, squared, np.inf))

    def density(self, directions: FloatArray) -> FloatArray:
        """(D, L) per steradian."""
        return np.asarray(
            directions_kernels.densities(directions, self.direction, self.precision, self.peak)
        )


def direction_prior(
    refined: Refined, config: RefineRoundsConfig, worker_count: int = 1
) -> DirectionPrior | None:
    """The prior of each line, from the directions that these lines share; None if it is off.

    Args:
        refined: lines with their information.
        config: as of `common_directions`.
        worker_count: threads; the answer is the same with any.
    """
    if config.direction_sigma_deg == 0.0 or len(refined) == 0:
        return None
    lines = _uncertain_directions(refined, config)
    common = _shared_by_many(lines, worker_count)
    weight = (config.direction_noise_px / np.deg2rad(config.direction_sigma_deg)) ** 2
    if len(common) == 0:
        return DirectionPrior(direction=lines.direction, weight=np.zeros(len(refined)))
    squared = lines.squared_distance(common)
    nearest = squared.argmin(axis=0)
    within = squared.min(axis=0) < config.max_direction_distance**2
    return DirectionPrior(direction=common[nearest], weight=weight * within)


def common_directions(refined: Refined, config: RefineRoundsConfig) -> FloatArray:
    """(D, 3) unit directions that many lines share, the most frequent first.

    Args:
        refined: lines with their information.
        config: noise of an observation, and how far lines deviate from a common direction.
    """
    return _shared_by_many(_uncertain_directions(refined, config))


def _shared_by_many(lines: _UncertainDirections, worker_count: int = 1) -> FloatArray:
    """(D, 3) unit directions, the most frequent first."""
    lines = lines.take(lines.spread_rad < MAX_SPREAD_RAD)
    votes = np.ones(len(lines.direction))
    by_chance = lines.reach.sum()
    least = max(
        MIN_LINE_COUNT,
        MIN_LINE_SHARE * len(votes),
        by_chance + CHANCE_DEVIATIONS * np.sqrt(by_chance),
    )
    found: list[FloatArray] = []
    if not votes.any():
        return np.empty((0, 3))
    candidates = _candidates(lines)
    # A block at a time: all candidates by all lines take long to write to memory and back.
    blocks = np.array_split(candidates, 1 + len(candidates) // CANDIDATE_BLOCK_COUNT)
    share = np.concatenate(
        list(in_order(lambda block: _explained(lines, block), blocks, worker_count))
    )
    while len(found) < MAX_DIRECTION_COUNT:
        strength = share @ votes
        # The mean shift can add lines to the best candidate, but hardly double them.
        if strength.max() < 0.5 * least:
            break
        direction = candidates[strength.argmax()]
        for _ in range(MEAN_SHIFT_COUNT):
            explained = _explained(lines, direction[None])[0]
            direction = _shifted(lines, direction, votes * explained)
        explained = _explained(lines, direction[None])[0]
        if votes @ explained < least:
            break
        found.append(direction)
        votes = np.where(explained > EXPLAINED_SHARE, 0.0, votes)
    return np.array(found).reshape(-1, 3)


def _explained(lines: _UncertainDirections, directions: FloatArray) -> FloatArray:
    """(D, L) probability that each line has these (D, 3) directions, against the background."""
    density = lines.density(directions)
    return np.asarray(density / (density + BACKGROUND_DENSITY))


def _shifted(lines: _UncertainDirections, direction: FloatArray, weight: FloatArray) -> FloatArray:
    """The direction that weighted lines agree on best: least squares, linearised at `direction`."""
    towards = np.sign(lines.direction @ direction)[:, None] * lines.direction
    weighted = weight[:, None, None] * lines.precision
    information = weighted.sum(axis=0)
    pull = np.einsum("lij,lj->i", weighted, towards - direction)
    # Steps along the direction itself do nothing; the outer product keeps the system regular.
    along = np.trace(information) * np.outer(direction, direction)
    return np.asarray(unit(direction + np.linalg.solve(information + along, pull)))


def _candidates(lines: _UncertainDirections) -> FloatArray:
    """(D, 3) directions of the most certain lines, and where the arcs of some of them cross."""
    most_certain = np.argsort(-lines.peak, kind="stable")[:CANDIDATE_LINE_COUNT]
    axis = lines.axis[most_certain[:PAIRED_LINE_COUNT]]
    first, second = np.triu_indices(len(axis), k=1)
    crossing = np.cross(axis[first], axis[second])
    length = np.linalg.norm(crossing, axis=1)
    # Arcs closer than a degree cross anywhere.
    clear = length > np.sin(np.deg2rad(1.0))
    return np.concatenate([lines.direction[most_certain], crossing[clear] / length[clear, None]])


def _uncertain_directions(refined: Refined, config: RefineRoundsConfig) -> _UncertainDirections:
    direction = refined.lines.direction
    dv, _ = refined.jacobians()
    covariance = config.direction_noise_px**2 * dv @ refined.covariance @ np.swapaxes(dv, -1, -2)
    # In an orthonormal basis of the tangent plane.
    _, _, basis = np.linalg.svd(direction[:, None, :])
    basis = basis[:, 1:]
    tangent = basis @ covariance @ np.swapaxes(basis, -1, -2)
    tangent += np.deg2rad(config.direction_sigma_deg) ** 2 * np.eye(2)
    variance, vectors = np.linalg.eigh(tangent)
    precision = np.swapaxes(basis, -1, -2) @ np.linalg.inv(tangent) @ basis
    return _UncertainDirections(
        direction=direction,
        precision=precision,
        peak=1.0 / (2.0 * np.pi * np.sqrt(variance.prod(axis=-1))),
        spread_rad=np.sqrt(variance[:, -1]),
        axis=np.einsum("lki,lk->li", basis, vectors[:, :, 0]),
    )
