import dataclasses

import numpy as np
import pytest

from roel_service.config.stages import FramesConfig, RefineConfig
from roel_service.mapping.evidence import measure_evidence
from roel_service.mapping.moments import event_forms, segment_forms

from .synthetic import world


@pytest.mark.parametrize("compensate_rotation", [True, False])
def test_events_have_their_own_poses_where_rotation_is_compensated(compensate_rotation):
    exact = world()
    frames_config = FramesConfig(slot_us=100, compensate_rotation=compensate_rotation)
    refine_config = RefineConfig(event_count_per_line=20)
    evidence = measure_evidence(
        exact.observations, exact.frames, exact.trajectory, frames_config, refine_config
    )
    poses = exact.trajectory if compensate_rotation else None
    expected = event_forms(exact.observations, exact.frames, poses, 100, 20)
    np.testing.assert_array_equal(evidence.event_forms, expected)
    # The events of a frame that shares one pose are met at its centre: no moment part.
    assert evidence.event_forms[:, :3].any() == compensate_rotation


def test_lines_and_counts_are_those_of_the_observations():
    exact = world()
    offsets = np.minimum(exact.observations.event_offsets, 100)
    few = dataclasses.replace(
        exact.observations,
        event_offsets=offsets,
        event_xy_px=exact.observations.event_xy_px[:100],
        event_dt_us=exact.observations.event_dt_us[:100],
    )
    evidence = measure_evidence(few, exact.frames, exact.trajectory, FramesConfig(), RefineConfig())
    assert evidence.event_counts.tolist() == [40, 40, 20] + [0] * 285
    config = RefineConfig(event_count_per_line=30)
    limited = measure_evidence(few, exact.frames, exact.trajectory, FramesConfig(), config)
    assert limited.event_counts.tolist() == [30, 30, 20] + [0] * 285
    np.testing.assert_array_equal(evidence.segment_forms, segment_forms(few, exact.frames))
    np.testing.assert_array_equal(evidence.views.normal, exact.views.normal)
