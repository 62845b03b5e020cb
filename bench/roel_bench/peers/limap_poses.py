"""LIMAP's own bundle adjustment of poses (pylimap), on lines and tracks of this project.

It runs where LIMAP maps do (see `limap`): in an environment and a process of its own.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np

from roel_bench.peers.limap import ENVIRONMENT, posed_images, run_worker
from roel_service.arrays import Array, FloatArray
from roel_service.errors import NoAnswerError, NotFoundError
from roel_service.geometry import plucker
from roel_service.geometry.se3 import SE3
from roel_service.mapping.front_end import Detected
from roel_service.mapping.refine import Refined
from roel_service.mapping.views import cuts_m, views_of

WORKER = Path(__file__).parent / "in_limap" / "adjust_poses.py"
ITERATION_COUNT = 200
TIMEOUT_S = 600.0


def is_installed(environment: Path = ENVIRONMENT) -> bool:
    """Whether `make limap` was run."""
    return (environment / "bin" / "python").exists()


def adjusted_poses(refined: Refined, detected: Detected, environment: Path = ENVIRONMENT) -> SE3:
    """(N) `T_world_camera` of the frames after bundle adjustment, the first one held.

    Args:
        refined: lines with their tracks.
        detected: frames with their first poses, and what was seen.
        environment: the virtual environment that has `pylimap`.

    Raises:
        NotFoundError: the environment does not exist.
        NoAnswerError: LIMAP failed or took too long.
    """
    if not is_installed(environment):
        raise NotFoundError("limap", "an environment made by `make limap`", str(environment))
    python = environment / "bin" / "python"
    with tempfile.TemporaryDirectory(prefix="roel-limap-") as folder:
        task, answer = Path(folder) / "problem.npz", Path(folder) / "answer.npz"
        write_problem(task, refined, detected)
        run_worker([str(python), "-Es", str(WORKER), str(task), str(answer)], TIMEOUT_S)
        return read_poses(answer, len(detected.frames))


def write_problem(path: Path, refined: Refined, detected: Detected) -> None:
    """Write the arrays that `in_limap/adjust_poses.py` reads."""
    frames, observations, tracks = detected.frames, detected.observations, refined.tracks
    line_offsets = np.searchsorted(observations.frame, np.arange(len(frames) + 1))
    frame = observations.frame[tracks.observation].astype(np.int64)
    local = tracks.observation - line_offsets[frame]
    np.savez(
        path,
        **posed_images(frames),
        segments_px=observations.segments_px,
        line_offsets=line_offsets,
        segments=seen_segments(refined, detected),
        track_offsets=tracks.offsets,
        observations=np.stack([frame, local], axis=1),
        iteration_count=ITERATION_COUNT,
    )


def seen_segments(refined: Refined, detected: Detected) -> FloatArray:
    """(L, 2, 3) world, m: each line as far as its observations reach."""
    direction, moment = refined.lines.direction, refined.lines.moment
    line = refined.tracks.track_of_row
    views = views_of(detected.observations, detected.frames).take(refined.tracks.observation)
    along_m = cuts_m(views, direction[line], moment[line])[0]
    nearest = plucker.nearest_to_origin(direction, moment)
    ends_m = np.zeros((len(refined), 2))
    for index in range(len(refined)):
        reach_m = along_m[line == index]
        reach_m = reach_m[np.isfinite(reach_m).all(axis=-1)]
        # Half of the observations reach at least so far: single ones may be cut anywhere.
        ends_m[index] = np.median(np.sort(reach_m, axis=-1), axis=0) if len(reach_m) else (0.0, 1.0)
    return np.asarray(nearest[:, None] + ends_m[..., None] * direction[:, None])


def read_poses(path: Path, count: int) -> SE3:
    """(N) `T_world_camera` of the worker's answer; raises `NoAnswerError` for anything else."""
    expected = f"{count} finite poses"
    if not path.exists():
        raise NoAnswerError("limap", expected, "no file", reason="PEER_FAILED")
    with np.load(path) as file:
        poses: Array = file["T_camera_world"]
    if poses.shape != (count, 3, 4) or not np.isfinite(poses).all():
        found = f"shape {poses.shape}, or values that are not finite"
        raise NoAnswerError("limap", expected, found, reason="PEER_FAILED")
    return SE3(rotation=poses[:, :, :3], translation=poses[:, :, 3]).inverse()
