"""The paper's cube: noisy poses against lines that were triangulated with true ones.

As published, the pipeline of preset `paper` runs up to triangulation with true poses; then noise is put
on positions and Euler angles, and each row refines lines and poses over the same tracks. The default
gets the same noisy poses and the events: once with the map that it builds with true poses, and once
alone, where it finds its lines itself.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from roel_bench.peers import limap_poses
from roel_bench.scenes import Scene
from roel_service.config.presets import preset
from roel_service.config.stages import Config, RefineConfig
from roel_service.errors import NoAnswerError
from roel_service.evaluation.poses import trajectory_errors
from roel_service.geometry.se3 import SE3
from roel_service.mapping.batch import refine_batch
from roel_service.mapping.detect import line_detector
from roel_service.mapping.first_lines import matched_tracks, triangulated_lines
from roel_service.mapping.front_end import Detected, lines_of_all_frames
from roel_service.mapping.pipeline import build_line_map
from roel_service.mapping.refine import Refined
from roel_service.mapping.refine_poses import refine_poses
from roel_service.mapping.run import CountedEvents, MappingRun
from roel_service.mapping.views import views_of
from roel_service.progress import ignore
from roel_service.scene.trajectory import Trajectory
from roel_service.simulate.motion import with_white_noise

# The cube is a few metres of a room large, in units: lengths of the default are in metres.
UNITS_PER_M = 10.0
POSE_RATE_HZ = 100.0
# What is left of the noise, in units, once its jitter is smoothed out.
SMOOTH_DRIFT = 0.1
STEP_COUNT = 60

PAPER = preset("paper").refine
LIMAP_2 = replace(
    PAPER, residual="reprojection", loss="cauchy", loss_scale_px=1.0, event_weight=0.0
)
# That of the LIMAP that the paper cites, but for a factor for angles, which is 1 but for some per cent here.
LIMAP_1 = replace(LIMAP_2, loss_scale_px=0.25)
# The paper's rows in the paper's order, then other readings: the loss of a later LIMAP, and the paper's
# squared cost.
METHODS: dict[str, RefineConfig | None] = {
    "none": None,
    "reprojection": LIMAP_1,
    "line Grassmann": replace(PAPER, event_weight=0.0),
    "line + event Grassmann": PAPER,
    "reprojection, LIMAP 2": LIMAP_2,
    "line Grassmann, quartic": replace(PAPER, event_weight=0.0, loss="quartic"),
    "line + event Grassmann, quartic": replace(PAPER, loss="quartic"),
}
# LIMAP's own bundle adjustment on the same tracks, where its environment is.
LIMAP_ITSELF = "LIMAP bundle adjustment"
# The default's rows: with the map of true poses, and from events and noisy poses alone.
IN_A_MAP, ALONE = "default, in the map", "default"


@dataclass(frozen=True, kw_only=True)
class CubeRow:
    """One refinement of the cube's poses.

    Attributes:
        method, seed: what was done, and what drew the noise.
        frame_count, line_count: poses and lines that were refined.
        ate_hundredths, sim3_hundredths: of a unit, after SE(3) and after Sim(3) alignment.
        scale: of that alignment.
        rotation_deg: root mean square.
        seconds: processor time; by the clock where LIMAP's process did the work.
    """

    method: str
    seed: int
    frame_count: int
    line_count: int
    ate_hundredths: float
    sim3_hundredths: float
    scale: float
    rotation_deg: float
    seconds: float


def cube_rows(scene: Scene, seeds: Iterable[int]) -> Iterator[CubeRow]:
    """Every method with every seed."""
    if scene.trajectory is None:
        raise NoAnswerError("cube", "true poses", "none")
    detected, refined = triangulated(scene, scene.trajectory)
    true = detected.frames.T_world_camera
    true_map = build_line_map(
        scene.events, scene.trajectory, scene.camera, default_config()
    ).line_map
    for seed in seeds:
        noisy = with_white_noise(true, 1.0, np.random.default_rng(seed))
        for method, config in METHODS.items():
            began = time.process_time()
            poses = noisy if config is None else _batch(detected, refined, noisy, config)
            seconds = time.process_time() - began
            yield _row(method, seed, detected, poses, len(refined), seconds, scene.trajectory)
        if limap_poses.is_installed():
            began = time.perf_counter()
            poses = limap_poses.adjusted_poses(refined, _moved(detected, noisy))
            seconds = time.perf_counter() - began
            yield _row(LIMAP_ITSELF, seed, detected, poses, len(refined), seconds, scene.trajectory)
        given = Trajectory(t_us=detected.frames.t_us, T_world_camera=noisy)
        for method, line_map in ((IN_A_MAP, true_map), (ALONE, None)):
            began = time.process_time()
            result = refine_poses(
                scene.events, given, scene.camera, default_config(), line_map=line_map
            )
            seconds = time.process_time() - began
            found = result.trajectory.T_world_camera
            lines = result.report.line_count
            yield _row(method, seed, detected, found, lines, seconds, scene.trajectory)


def default_config() -> Config:
    """The default in units of the cube, for poses that are off each by itself.

    Their noise is white up to half their rate, so that frames are as many as they are, and the
    correction may change faster than an odometry's drift does.
    """
    config = preset("default")
    trim = config.trim
    return replace(
        config,
        frames=replace(config.frames, rate_hz=POSE_RATE_HZ),
        refine=replace(
            config.refine,
            pose_rate_hz=2.0 * POSE_RATE_HZ,
            pose_interval_us=50_000,
            pose_drift_m=SMOOTH_DRIFT,
            pose_drift_s=0.3,
        ),
        trim=replace(
            trim,
            max_gap_m=UNITS_PER_M * trim.max_gap_m,
            min_length_m=UNITS_PER_M * trim.min_length_m,
            max_error_m=UNITS_PER_M * trim.max_error_m,
        ),
    )


def triangulated(scene: Scene, trajectory: Trajectory) -> tuple[Detected, Refined]:
    """What preset `paper` detects and triangulates with true poses."""
    config, run = preset("paper"), MappingRun(ignore)
    counted = CountedEvents(scene.events, trajectory)
    detector = line_detector(config.detect)
    detected = lines_of_all_frames(counted, trajectory, scene.camera, config, detector, run)
    tracks = matched_tracks(detected, config, None, None, run)
    rng = np.random.default_rng(config.runtime.seed)
    refined = triangulated_lines(tracks, detected.evidence, detected.frames, config, rng, run)
    return detected, refined


def _batch(detected: Detected, refined: Refined, noisy: SE3, config: RefineConfig) -> SE3:
    config = replace(config, pose_iteration_count=STEP_COUNT)
    return refine_batch(refined, _moved(detected, noisy), config).T_world_camera


def _moved(detected: Detected, poses: SE3) -> Detected:
    """What was seen, by frames with other poses."""
    frames = replace(detected.frames, T_world_camera=poses)
    views = views_of(detected.observations, frames)
    return replace(detected, frames=frames, evidence=replace(detected.evidence, views=views))


def _row(
    method: str,
    seed: int,
    detected: Detected,
    poses: SE3,
    line_count: int,
    seconds: float,
    truth: Trajectory,
) -> CubeRow:
    estimate = Trajectory(t_us=detected.frames.t_us, T_world_camera=poses)
    errors = trajectory_errors(estimate, truth)
    scaled = trajectory_errors(estimate, truth, with_scale=True)
    return CubeRow(
        method=method,
        seed=seed,
        frame_count=len(poses.translation),
        line_count=line_count,
        ate_hundredths=100.0 * errors.ate_rmse_m,
        sim3_hundredths=100.0 * scaled.ate_rmse_m,
        scale=scaled.scale,
        rotation_deg=errors.rotation_rms_deg,
        seconds=seconds,
    )
