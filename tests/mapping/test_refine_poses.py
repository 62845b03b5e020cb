import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from roel_service.config.stages import RefineConfig
from roel_service.errors import Cancelled, NoAnswerError
from roel_service.evaluation.poses import trajectory_errors, translation_errors_m
from roel_service.geometry.alignment import align_points
from roel_service.mapping import pose_windows
from roel_service.mapping.intrinsics_search import with_focal
from roel_service.mapping.joint import FEIGNED_DRIFT
from roel_service.mapping.pipeline import build_line_map
from roel_service.mapping.refine_poses import (
    RATE_FOCAL_PX,
    closing_gates,
    gates_px,
    in_likeliest_world,
    refine_poses,
)
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseProblem
from roel_service.scene.trajectory import Trajectory

from .synthetic import CAMERA, SEGMENTS_WORLD, event_stream, trajectory
from .test_pipeline import CONFIG

# Half as far off in pixels, with an image a quarter as wide as those that the defaults are for.
JITTER_M, JITTER_RAD = 0.002, 0.001
DRIFT_M, DRIFT_RAD = 0.006, 0.003


def noisy_trajectory(seed=0):
    """Jitter, and a drift that swings once a second."""
    truth = trajectory()
    rng = np.random.default_rng(seed)
    jitter = rng.normal(size=(len(truth), 6)) * ([JITTER_RAD] * 3 + [JITTER_M] * 3)
    phase = 2 * np.pi * truth.t_us[:, None] * 1e-6 + rng.uniform(0, 2 * np.pi, 6)
    drift = np.sin(phase) * ([DRIFT_RAD] * 3 + [DRIFT_M] * 3)
    poses = truth.T_world_camera.retract(jitter + drift)
    return Trajectory(t_us=truth.t_us, T_world_camera=poses)


@pytest.fixture(scope="module")
def noisy():
    return noisy_trajectory()


@pytest.fixture(scope="module")
def found(noisy):
    return refine_poses(event_stream(), noisy, CAMERA, CONFIG)


class TestTogetherWithTheLines:
    def test_poses_get_better(self, noisy, found):
        before = trajectory_errors(noisy, trajectory())
        after = trajectory_errors(found.trajectory, trajectory())
        # Lines of 160 px images hold rotations to some 0.3 px of 120 px focal length.
        assert after.ate_rmse_m < 0.7 * before.ate_rmse_m
        assert after.rotation_rms_deg < 0.7 * before.rotation_rms_deg
        np.testing.assert_array_equal(found.trajectory.t_us, noisy.t_us)

    def test_the_report_tells_what_was_done(self, noisy, found):
        report = found.report
        assert 6 <= report.line_count <= 3 * len(SEGMENTS_WORLD)
        assert report.cost_final < report.cost_initial
        assert report.iteration_count >= len(CONFIG.refine.pose_gates_px)
        assert report.seconds["refine"] > 0.0
        assert found.covariance.shape == (len(noisy), 6, 6)
        # No pose is known better than what all observations of a line have in common.
        variances = np.diagonal(found.covariance, axis1=1, axis2=2)
        assert variances[:, :3].min() >= FEIGNED_DRIFT.sigma_rad**2
        assert variances[:, 3:].min() >= FEIGNED_DRIFT.sigma_m**2
        assert np.linalg.eigvalsh(found.covariance).min() > 0.0

    def test_the_result_is_aligned_to_the_given_poses(self, noisy, found):
        shift = found.trajectory.T_world_camera.translation - noisy.T_world_camera.translation
        np.testing.assert_allclose(shift.mean(axis=0), 0.0, atol=1e-9)

    def test_the_result_is_as_large_as_the_given_poses(self, noisy, found):
        paths = (found.trajectory.T_world_camera, noisy.T_world_camera)
        fit = align_points(*(poses.translation for poses in paths), with_scale=True)
        assert fit.scale == pytest.approx(1.0, abs=1e-9)

    def test_good_poses_are_not_harmed(self):
        found = refine_poses(event_stream(), trajectory(), CAMERA, CONFIG)
        # A hundredth of a pixel at 2 m.
        assert trajectory_errors(found.trajectory, trajectory()).ate_rmse_m < 0.0001

    def test_a_map_with_free_poses_is_that_of_the_refined_ones(self, noisy, found):
        free = dataclasses.replace(
            CONFIG, refine=dataclasses.replace(CONFIG.refine, free_poses=True)
        )
        fractions = []
        built = build_line_map(
            event_stream(),
            noisy,
            CAMERA,
            free,
            progress=lambda step: fractions.append(step.fraction),
        )
        placed = in_likeliest_world(found.trajectory, noisy, CONFIG.refine)
        np.testing.assert_array_equal(
            built.trajectory.T_world_camera.matrix(), placed.T_world_camera.matrix()
        )
        again = build_line_map(event_stream(), placed, CAMERA, CONFIG)
        np.testing.assert_array_equal(built.line_map.segments, again.line_map.segments)
        assert fractions == sorted(fractions)
        assert built.report.seconds["refine"] > again.report.seconds["refine"]


class TestAClockThatIsOff:
    """Poses that are stamped 30 ms late."""

    @pytest.mark.parametrize("estimate", [False, pytest.param(True, marks=pytest.mark.slow)])
    def test_it_is_told_or_mended(self, estimate, caplog):
        truth = trajectory()
        late = Trajectory(t_us=truth.t_us + 30_000, T_world_camera=truth.T_world_camera)
        found = refine_poses(event_stream(), late, CAMERA, CONFIG, estimate_time_offset=estimate)
        report = found.report
        assert report.time_offset_us == pytest.approx(-30_000, abs=5_000)
        assert (PoseProblem.TIME_OFFSET in report.problems) == (not estimate)
        assert ("their clock is not that of the events" in caplog.text) == (not estimate)
        np.testing.assert_array_equal(found.trajectory.t_us, late.t_us)
        if estimate:
            assert report.time_offset_us == pytest.approx(-30_000, abs=1_000)
            # The last 30 ms have no pose of their own and stay at the end.
            inside = slice(0, -10)
            moved = found.trajectory.T_world_camera[inside]
            true = truth.interpolate(np.minimum(late.t_us, truth.t_us[-1]))[inside]
            assert translation_errors_m(moved, true).mean() < 0.05


@pytest.mark.slow
def test_a_focal_length_that_is_too_short_is_found():
    shorter = with_focal(CAMERA, -0.03)
    found = refine_poses(event_stream(), trajectory(), shorter, CONFIG, estimate_intrinsics=True)
    intrinsics = found.report.intrinsics
    assert intrinsics.focal.is_applied
    assert abs(0.97 * (1.0 + intrinsics.focal.change) - 1.0) < 3.0 * intrinsics.focal.sigma
    # Twelve lines hardly tell the principal point, and say so.
    for error in (intrinsics.principal_x, intrinsics.principal_y):
        assert abs(error.change) < 3.0 * error.sigma
    assert trajectory_errors(found.trajectory, trajectory()).ate_rmse_m < 0.005


def test_poses_that_jump_are_told(noisy):
    tangents = np.zeros((len(noisy), 6))
    tangents[len(noisy) // 2 :, 3] = 0.2
    jumping = Trajectory(t_us=noisy.t_us, T_world_camera=noisy.T_world_camera.retract(tangents))
    found = refine_poses(event_stream(), jumping, CAMERA, CONFIG)
    assert PoseProblem.JUMPS in found.report.problems


class TestInAMap:
    def test_poses_find_their_place(self, noisy):
        line_map = LineMap.from_segments(SEGMENTS_WORLD)
        found = refine_poses(event_stream(), noisy, CAMERA, CONFIG, line_map=line_map)
        given, after = (
            np.linalg.norm(
                poses.T_world_camera.translation - trajectory().T_world_camera.translation, axis=1
            )
            for poses in (noisy, found.trajectory)
        )
        # A pixel is 17 mm wide at 2 m; the given poses were off by 8 mm.
        assert after.mean() < 0.75 * given.mean()

    def test_a_map_out_of_view_holds_nothing(self, noisy):
        line_map = LineMap.from_segments(SEGMENTS_WORLD - np.array([0.0, 0.0, 100.0]))
        with pytest.raises(NoAnswerError, match="at least 6 lines in view, found 0") as caught:
            refine_poses(event_stream(), noisy, CAMERA, CONFIG, line_map=line_map)
        assert caught.value.reason == "TOO_FEW_LINES"


def test_a_long_recording_is_refined_in_windows(noisy, found, monkeypatch):
    monkeypatch.setattr(pose_windows, "MAX_CONTROL_COUNT", 16)
    monkeypatch.setattr(pose_windows, "WINDOW_INTERVAL_COUNT", 12)
    windowed = refine_poses(event_stream(), noisy, CAMERA, CONFIG)
    before = trajectory_errors(noisy, trajectory())
    after = trajectory_errors(windowed.trajectory, trajectory())
    assert after.ate_rmse_m < 0.8 * before.ate_rmse_m
    assert windowed.report.line_count > found.report.line_count
    np.testing.assert_array_equal(windowed.trajectory.t_us, noisy.t_us)
    # Nothing jumps where one window fades into the other.
    steps = np.diff(windowed.trajectory.T_world_camera.translation, axis=0)
    assert np.linalg.norm(np.diff(steps, axis=0), axis=1).max() < 0.001


def test_it_can_be_cancelled(noisy):
    def cancel(progress):
        raise Cancelled

    with pytest.raises(Cancelled):
        refine_poses(event_stream(), noisy, CAMERA, CONFIG, progress=cancel)


@pytest.mark.parametrize(
    ("focal_px", "given_px", "expected_px"),
    [
        (100.0, (3.0, 2.0, 1.3), (3.0, 2.0, 1.3)),
        (440.0, (3.0, 1.5), (6.0, 1.5)),
        (440.0, (4.0, 2.0, 1.0), (6.0, np.sqrt(6.0), 1.0)),
        (440.0, (2.0,), (2.0,)),
    ],
)
def test_gates_begin_as_wide_as_poses_are_turned(focal_px, given_px, expected_px):
    turn_deg = float(np.degrees(6.0 / 440.0))
    config = RefineConfig(pose_gates_px=given_px, pose_turn_deg=turn_deg)
    np.testing.assert_allclose(gates_px(config, focal_px), expected_px)


@pytest.mark.parametrize(
    ("moved_px", "gates"),
    [
        ([0.04, 0.04], [1.0, 2.0]),
        # The first gate closes once lines stay; a twentieth of it is enough.
        ([0.3, 0.06, 0.05, 0.0], [1.0, 1.0, 1.0, 2.0]),
        # Lines that never stay are not waited for.
        ([0.3] * 6, [1.0] * 3 + [2.0] * 3),
    ],
)
def test_a_gate_closes_once_the_lines_stay(moved_px, gates):
    found = []
    taken = []
    for gate_px in closing_gates([1.0, 2.0], found):
        taken.append(gate_px)
        found.append(SimpleNamespace(moved_px=moved_px[len(found)]))
    assert taken == gates


def test_poses_take_as_many_frames_as_are_asked_for(noisy, found):
    rate_hz = CONFIG.frames.rate_hz / 2 * CAMERA.focal_px / RATE_FOCAL_PX
    fewer = dataclasses.replace(CONFIG.refine, pose_rate_hz=rate_hz)
    config = dataclasses.replace(CONFIG, refine=fewer)
    report = refine_poses(event_stream(), noisy, CAMERA, config).report
    assert 0.3 < report.observation_count / found.report.observation_count < 0.7
