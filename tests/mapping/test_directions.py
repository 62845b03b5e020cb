import numpy as np
import pytest

from roel_service.config.stages import RefineConfig
from roel_service.geometry import plucker
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.geometry.vectors import unit
from roel_service.mapping.directions import (
    _uncertain_directions,
    common_directions,
    direction_prior,
)
from roel_service.mapping.refine import Refined, refine_lines
from roel_service.scene.lines import InfiniteLines, LineTracks

from .synthetic import line_errors, world

CONFIG = RefineConfig(direction_sigma_deg=0.5, direction_noise_px=1.0)
# Neither along the axes nor perpendicular to each other.
SHARED = unit(np.array([[0.2, 0.1, 1.0], [1.0, 0.3, 0.0], [-0.4, 1.0, 0.3]]))


def lines_with(direction, across_deg, along_deg, seed=0):
    """Lines at random places with known uncertainty.

    The direction is known to `across_deg` out of the plane of line and origin, and to `along_deg`
    within it; the true directions deviate by as much.
    """
    rng = np.random.default_rng(seed)
    plane = unit(np.cross(direction, rng.normal(size=direction.shape)))
    within = np.cross(plane, direction)
    noise = np.deg2rad([across_deg, along_deg]) * rng.normal(size=(len(direction), 2))
    noisy = unit(direction + noise[:, :1] * plane + noise[:, 1:] * within)
    plane = unit(plane - np.sum(plane * noisy, axis=1)[:, None] * noisy)
    # In the orthonormal tangent the third step turns the line out of the plane, the second within.
    sigma = np.array([0.01, np.deg2rad(along_deg), np.deg2rad(across_deg), 0.01])
    information = np.broadcast_to(np.diag(sigma**-2.0), (len(direction), 4, 4)).copy()
    return Refined(
        lines=InfiniteLines(direction=noisy, moment=3.0 * plane),
        tracks=LineTracks.from_lists([np.empty(0, np.int32)] * len(direction)),
        rms_px=np.zeros(len(direction)),
        origin=np.zeros((len(direction), 3)),
        information=information,
        diverged=np.zeros(len(direction), dtype=bool),
    )


def angles_deg(found, true):
    """Of each true direction, the angle to the nearest found one."""
    return np.rad2deg(np.arccos(np.minimum(np.abs(true @ found.T).max(axis=1), 1.0)))


def turned(refined, R):
    return Refined(
        **{
            **vars(refined),
            "lines": InfiniteLines(
                direction=refined.lines.direction @ R.T, moment=refined.lines.moment @ R.T
            ),
        }
    )


class TestCommonDirections:
    def test_certain_lines_give_the_directions_that_they_share(self):
        found = common_directions(lines_with(np.repeat(SHARED, 15, axis=0), 0.3, 0.3), CONFIG)
        assert len(found) == 3
        # 0.3 degrees over 15 lines in two axes: three standard deviations are 0.33 degrees.
        assert angles_deg(found, SHARED).max() < 0.33

    def test_arcs_give_the_directions_in_which_they_cross(self):
        lines = lines_with(np.repeat(SHARED, 25, axis=0), 0.2, 8.0)
        single = angles_deg(lines.lines.direction, SHARED)
        found = common_directions(lines, CONFIG)
        assert len(found) == 3
        # Across its arc each line holds the direction to sqrt(0.2^2 + 0.5^2) = 0.54 degrees; arcs
        # lie in all azimuths, so 25 of them hold it to 0.54 sqrt(2 / 25) = 0.15 in each axis.
        assert angles_deg(found, SHARED).max() < 0.5
        assert np.median(single) < 1.0  # some line is always close; which one, nobody knows
        spread = angles_deg(SHARED, lines.lines.direction)
        assert np.median(spread) > 3.0

    def test_unrelated_lines_share_no_direction(self):
        directions = unit(np.random.default_rng(3).normal(size=(60, 3)))
        assert len(common_directions(lines_with(directions, 0.3, 0.3), CONFIG)) == 0

    def test_turning_the_world_turns_the_directions(self):
        lines = lines_with(np.repeat(SHARED, 15, axis=0), 0.3, 5.0)
        R = rotation_from_vector(np.array([0.3, -1.1, 0.7]))
        before = common_directions(lines, CONFIG)
        after = common_directions(turned(lines, R), CONFIG)
        assert len(before) == len(after)
        np.testing.assert_allclose(np.abs(np.sum(before @ R.T * after, axis=1)), 1.0, atol=1e-9)

    def test_without_lines_there_are_none(self):
        empty = lines_with(np.empty((0, 3)), 0.3, 0.3)
        assert direction_prior(empty, CONFIG) is None


class TestPrior:
    def test_only_lines_that_may_have_a_shared_direction_are_held(self):
        odd = unit(np.array([[1.0, 1.0, 1.0], [0.0, 1.0, -1.0]]))
        directions = np.concatenate([np.repeat(SHARED, 15, axis=0), odd])
        prior = direction_prior(lines_with(directions, 0.1, 0.1), CONFIG)
        held = prior.weight > 0
        assert held[:45].all()
        assert not held[45:].any()
        assert angles_deg(SHARED, prior.direction[:45]).max() < 0.2

    def test_it_can_be_switched_off(self):
        lines = lines_with(np.repeat(SHARED, 15, axis=0), 0.3, 0.3)
        assert direction_prior(lines, RefineConfig(direction_sigma_deg=0.0)) is None

    @pytest.mark.parametrize("weight", [0.0, 1e12])
    def test_refinement_follows_a_strong_prior_and_nothing_else_moves(self, weight):
        exact = world()
        config = RefineConfig(loss="squared", max_residual_px=1e6, iteration_count=20)
        direction, _ = plucker.plucker_from_endpoints(exact.segments)
        wanted = direction @ rotation_from_vector(np.array([0.0, 0.02, 0.01])).T
        lines = lines_with(direction, 0.1, 0.1)
        prior = direction_prior(lines, CONFIG)
        prior = type(prior)(direction=wanted, weight=np.full(len(direction), weight))
        found = refine_lines(
            exact.lines, exact.tracks, exact.evidence(config), exact.frames, config, prior
        )
        cosine = np.abs(np.sum(found.lines.direction * wanted, axis=1))
        if weight:
            # Observations pull with less than 1e6 px^2/rad^2: a share of 1e-6 of the angle.
            np.testing.assert_allclose(cosine, 1.0, atol=1e-10)
        else:
            assert line_errors(found.lines, exact.segments).max() < 1e-6


def test_densities_are_those_of_normal_distributions():
    lines = lines_with(np.repeat(SHARED, 4, axis=0), across_deg=1.0, along_deg=5.0)
    uncertain = _uncertain_directions(lines, CONFIG)
    rng = np.random.default_rng(1)
    asked = unit(np.concatenate([SHARED, SHARED + 0.05 * rng.normal(size=(3, 3)), -SHARED]))
    squared = uncertain.squared_distance(asked)
    expected = uncertain.peak * np.exp(-0.5 * squared)
    assert np.isinf(squared).any()
    assert (expected > 0.1 * uncertain.peak).any()
    np.testing.assert_allclose(uncertain.density(asked), expected, rtol=1e-9, atol=1e-20)
