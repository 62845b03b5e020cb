from dataclasses import replace

import numpy as np
import pytest

from roel_service.config.stages import Config, RefineConfig, TrimConfig
from roel_service.mapping.corners import corner_prior, held_at_corners
from roel_service.mapping.refine import PointPrior, refine_lines
from roel_service.mapping.trim import observed_pieces
from roel_service.scene.lines import LineTracks

from .synthetic import line_errors, world, world_of

CORNER = np.array([0.2, 0.1, 0.1])
# Two edges end at the corner, each where many frames see it; so does the one that few see.
HELD = [[CORNER, [0.25, -0.5, 0.2]], [CORNER, [0.7, 0.3, 0.4]]]
LOOSE = [CORNER, [-0.5, 0.15, 0.0]]
CONFIG = Config(
    # The loss bends beyond the noise of the sample.
    refine=RefineConfig(
        loss_scale_px=0.7, direction_sigma_deg=0.0, max_residual_px=20.0, corner_depth_m=0.1
    ),
    trim=TrimConfig(min_coverage_count=1),
)
FEW_FRAMES = 5


def seen(held, noise_px=0.3):
    """Edges of which the last one is seen in a few frames alone: world, evidence, and the lines."""
    sample = world_of([*held, LOOSE], frame_count=48, noise_px=noise_px)
    frame = sample.observations.frame
    rows = np.flatnonzero((sample.line_of < len(held)) | (frame < FEW_FRAMES))
    tracks = LineTracks.from_rows(sample.line_of[rows], rows, len(sample.segments))
    evidence = sample.evidence(CONFIG.refine)
    refined = refine_lines(sample.lines, tracks, evidence, sample.frames, CONFIG.refine)
    return sample, evidence, refined


def errors_m(sample, refined):
    """(L,) distance of each refined line from the corner."""
    lines = refined.lines
    return np.linalg.norm(np.cross(CORNER, lines.direction) - lines.moment, axis=1)


def test_a_loose_line_is_held_where_two_others_end():
    sample, evidence, refined = seen(HELD)
    held = held_at_corners(refined, evidence, sample.frames, CONFIG)
    before, after = errors_m(sample, refined), errors_m(sample, held)
    assert before[2] > 0.2
    assert after[2] < 0.01
    np.testing.assert_allclose(after[:2], before[:2], atol=1e-3)


def test_what_is_held_is_certain_to_the_map():
    sample, evidence, refined = seen(HELD)
    held = held_at_corners(refined, evidence, sample.frames, CONFIG)
    before, after = (
        observed_pieces(lines, evidence.views, sample.frames, CONFIG.trim).sigma_m[2]
        for lines in (refined, held)
    )
    assert after < 0.8 * before


@pytest.mark.parametrize(
    "others",
    [
        HELD[:1],
        # In the picture they end at one place, but not in space.
        [HELD[0], [[0.29, 0.145, 1.045], [0.8, 0.3, 1.2]]],
    ],
)
def test_a_single_voice_is_not_believed(others):
    sample, evidence, refined = seen(others)
    assert not corner_prior(refined, evidence, sample.frames, CONFIG).weight.any()
    assert held_at_corners(refined, evidence, sample.frames, CONFIG) is refined


def test_corners_can_be_left_alone():
    sample, evidence, refined = seen(HELD)
    off = replace(CONFIG, refine=replace(CONFIG.refine, corner_sigma_m=0.0))
    assert held_at_corners(refined, evidence, sample.frames, off) is refined


def test_without_lines_there_are_no_corners():
    sample, evidence, refined = seen(HELD)
    nothing = refined.take(np.zeros(len(refined), dtype=bool))
    assert held_at_corners(nothing, evidence, sample.frames, CONFIG) is nothing


@pytest.mark.parametrize("weight", [0.0, 1e12])
def test_refinement_follows_a_strong_corner_and_nothing_else_moves(weight):
    exact = world()
    config = RefineConfig(loss="squared", max_residual_px=1e6, iteration_count=20)
    point = exact.segments.mean(axis=1) + np.array([0.02, -0.03, 0.05])
    corners = PointPrior(point=point, weight=np.full(len(point), weight))
    found = refine_lines(
        exact.lines,
        exact.tracks,
        exact.evidence(config),
        exact.frames,
        config,
        corners=corners,
    )
    lines = found.lines
    distance = np.linalg.norm(np.cross(point, lines.direction) - lines.moment, axis=1)
    if weight:
        assert distance.max() < 1e-6
    else:
        assert line_errors(lines, exact.segments).max() < 1e-6
