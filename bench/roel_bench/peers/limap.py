"""LIMAP (Liu et al., CVPR 2023) on event frames, through the authors' package.

LIMAP triangulates, links, filters and refines; what it is given is made here: event frames, lines,
matches, poses. Its package brings an OpenCV wheel that would overwrite this project's, and some of
its checks abort the process, so it runs in an environment (`make limap`) and a process of its own,
with arrays as files between (folder `in_limap`).

Choices that make the comparison fair are in `limap_lines.py` and `LIMAP_SETTINGS`. The RoEL paper
ran LIMAP with SOLD2, whose weights are downloaded at first use, on one image a frame with 60
visual neighbours; here it is LSD with LBD or with exhaustive matching, which is reported as such.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from roel_bench.peers.limap_lines import FrameLines, best_matches, detected_lines
from roel_service.arrays import Array, FloatArray, IntArray
from roel_service.config.stages import Config, DetectConfig, FramesConfig
from roel_service.errors import ConfigError, EventsError, NoAnswerError, NotFoundError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.vectors import norm
from roel_service.mapping.detect import detect_lines, line_detector
from roel_service.mapping.frames import Frames, event_frame, frame_slices, frame_times, frames_at
from roel_service.mapping.match_local import match_adjacent_frames
from roel_service.mapping.match_sampled import GeometricMatcher, match_sampled_frames
from roel_service.mapping.plane_fit import (
    FittedLines,
    fit_space_time_planes,
    observations_of_frames,
)
from roel_service.mapping.representations import event_images
from roel_service.mapping.views import views_of
from roel_service.progress import Progress, ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.lines import LineObservations, LineTracks
from roel_service.scene.trajectory import Trajectory

# The environment that `make limap` makes, and the script that runs in it.
ENVIRONMENT = Path(__file__).parents[3] / ".venv-limap"
WORKER = Path(__file__).parent / "in_limap" / "map_lines.py"
LINES = ("lsd", "own")
# Characters of the worker's last words that an error repeats.
MAX_ERROR_LENGTH = 300


@dataclass(frozen=True, kw_only=True)
class LimapDefaults:
    """Thresholds of one release of LIMAP, where the two differ.

    Attributes:
        triangulation: fields of `GlobalLineTriangulationOptions`.
        linker3d: fields of its 3D linker.
        loss_scale_px: scale of the Cauchy loss.
        loss_length_px: a line of this length has weight 1.
    """

    triangulation: dict[str, float]
    linker3d: dict[str, float]
    loss_scale_px: float
    loss_length_px: float


# The default file of the original repository, with which the RoEL paper compares.
LIMAP_1 = LimapDefaults(
    triangulation={"scale_inv_th": 0.015, "min_visible_views": 4},
    linker3d={"th_overlap": 0.05, "th_smartoverlap": 0.1, "th_smartangle": 2.0},
    loss_scale_px=0.25,
    loss_length_px=30.0,
)
LIMAP_2 = LimapDefaults(triangulation={}, linker3d={}, loss_scale_px=1.0, loss_length_px=60.0)


@dataclass(frozen=True, kw_only=True)
class LimapSettings:
    """How LIMAP's input is made, and which of its thresholds apply.

    Attributes:
        lines: `lsd` on event frames, or `own`, this project's front end.
        representation: what the event frames show: `binary` or `count_sum`.
        compensate_rotation: undo the camera's rotation within a frame.
        window_events_per_pixel: events of a frame.
        blur_px: standard deviation of the Gaussian that frames are smoothed with.
        max_ridge_px: flanks this close become their centre line; 0 keeps all flanks.
        min_length_px: shortest 2D line.
        match_count: best matches of each line, by LBD; 0 lets LIMAP try all pairs.
        frame_stride: every how many frames, of 30 a second, one is used.
        neighbor_count: nearest frames each frame is matched with.
        defaults: LIMAP's thresholds and loss.
        timeout_s: how long LIMAP may run.
    """

    lines: str = "lsd"
    representation: str = "count_sum"
    compensate_rotation: bool = True
    window_events_per_pixel: float = 0.2
    blur_px: float = 0.5
    max_ridge_px: float = 8.0
    min_length_px: float = 10.0
    match_count: int = 10
    frame_stride: int = 1
    neighbor_count: int = 60
    defaults: LimapDefaults = LIMAP_1
    timeout_s: float = 3600.0

    def __post_init__(self) -> None:
        if self.lines not in LINES:
            raise ConfigError("limap.lines", "one of " + ", ".join(LINES), self.lines)


@dataclass(frozen=True, eq=False, kw_only=True)
class Problem:
    """What LIMAP is asked.

    Attributes:
        frames: times, poses and calibration of the N frames.
        segments_px: (N) of (S, 2, 2) lines of each frame.
        matches: matched lines (Q, 2) of pairs of frames.
        neighbors: frames that each frame is compared with exhaustively; empty where matched.
    """

    frames: Frames
    segments_px: list[FloatArray]
    matches: dict[tuple[int, int], IntArray]
    neighbors: list[IntArray]


def map_segments(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: LimapSettings,
    progress: ProgressCallback = ignore,
    environment: Path = ENVIRONMENT,
) -> FloatArray:
    """LIMAP's line map of a recording.

    Args:
        events: read once, front to back.
        trajectory, camera: poses and calibration, both held fixed.
        settings: see `LIMAP_SETTINGS`.
        progress: called with each frame; may raise `Cancelled`.
        environment: the virtual environment that has `pylimap`.

    Returns:
        (L, 2, 3) segments, world, m.

    Raises:
        NotFoundError: the environment does not exist.
        EventsError: no frame has events around it.
        NoAnswerError: LIMAP failed or took too long.
    """
    python = environment / "bin" / "python"
    if not python.exists():
        raise NotFoundError("limap", "an environment made by `make limap`", str(environment))
    problem = PROBLEMS[settings.lines](events, trajectory, camera, settings, progress)
    return solve(problem, settings, python)


def solve(problem: Problem, settings: LimapSettings, python: Path) -> FloatArray:
    """(L, 2, 3) segments, world, m: LIMAP's answer, by the interpreter that has it.

    Raises:
        NoAnswerError: LIMAP failed or took too long.
    """
    with tempfile.TemporaryDirectory(prefix="roel-limap-") as folder:
        task, answer = Path(folder) / "problem.npz", Path(folder) / "answer.npz"
        write_problem(task, problem, settings)
        run_worker([str(python), "-Es", str(WORKER), str(task), str(answer)], settings.timeout_s)
        return read_segments(answer)


def detected_problem(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: LimapSettings,
    progress: ProgressCallback,
) -> Problem:
    """LSD's lines on event frames, with their best matches or none."""
    times_us: list[int] = []
    lines: list[FrameLines] = []
    for t_us, found in _lines_of_frames(events, trajectory, camera, settings, progress):
        times_us.append(t_us)
        lines.append(found)
    frames = _frames(times_us, trajectory, camera)
    neighbors = nearest_frames(frames, settings.neighbor_count)
    matches = {}
    if settings.match_count:
        matches = {
            (i, j): best_matches(lines[i], lines[j], settings.match_count)
            for i, j in _pairs(neighbors)
        }
        neighbors = []
    segments_px = [found.segments_px for found in lines]
    return Problem(frames=frames, segments_px=segments_px, matches=matches, neighbors=neighbors)


def _lines_of_frames(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: LimapSettings,
    progress: ProgressCallback,
) -> Iterator[tuple[int, FrameLines]]:
    frames = FramesConfig(compensate_rotation=settings.compensate_rotation)
    detect = DetectConfig(
        representations=(settings.representation,),
        window_events_per_pixel=(settings.window_events_per_pixel,),
        blur_px=settings.blur_px,
    )
    ideal_px = undistortion_table(camera)
    times_us = frame_times(trajectory, events.time_range_us, frames)[:: settings.frame_stride]
    slices = frame_slices(events.chunks(), times_us, frames.max_half_window_us)
    for count, (t_us, stream) in enumerate(slices, start=1):
        frame = event_frame(stream, t_us, ideal_px, trajectory, camera, frames, detect)
        for image in event_images(frame, detect):
            yield t_us, detected_lines(image.grey, settings.min_length_px, settings.max_ridge_px)
        _tell(progress, count, len(times_us))


def own_problem(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: LimapSettings,
    progress: ProgressCallback,
) -> Problem:
    """This project's lines and tracks, so that triangulation and refinement alone differ."""
    config = Config()
    times_us: list[int] = []
    fitted: list[FittedLines] = []
    detector = line_detector(config.detect)
    ideal_px = undistortion_table(camera)
    wanted_us = frame_times(trajectory, events.time_range_us, config.frames)
    slices = frame_slices(events.chunks(), wanted_us, config.frames.max_half_window_us)
    for t_us, stream in slices:
        frame = event_frame(
            stream, t_us, ideal_px, trajectory, camera, config.frames, config.detect
        )
        seeds = detect_lines(event_images(frame, config.detect), detector, config.detect)
        rng = np.random.default_rng(len(times_us))  # not drawn from by the default method
        times_us.append(t_us)
        fitted.append(fit_space_time_planes(seeds, frame, config.plane_fit, rng))
        _tell(progress, len(times_us), len(wanted_us))
    frames = _frames(times_us, trajectory, camera)
    observations = observations_of_frames(fitted)
    tracks = match_adjacent_frames(observations, frames, config.match_local)
    views = views_of(observations, frames)
    matcher = GeometricMatcher(tracks, views, frames, config)
    tracks = match_sampled_frames(tracks, views, frames, config, matcher, lambda done, total: None)
    return tracked_problem(frames, observations, tracks, settings.frame_stride)


def tracked_problem(
    frames: Frames, observations: LineObservations, tracks: LineTracks, frame_stride: int
) -> Problem:
    """Every so many frames with their lines; lines of one track match each other.

    Args:
        frames: all N frames.
        observations: lines of all frames, sorted by frame.
        tracks: which of them are the same line.
        frame_stride: every how many frames one stays.
    """
    kept = np.arange(0, len(frames), frame_stride)
    first = np.searchsorted(observations.frame, np.arange(len(frames) + 1))
    rows_of_pair: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for rows in tracks_of(tracks):
        frame = observations.frame[rows]
        rows, frame = rows[frame % frame_stride == 0], frame[frame % frame_stride == 0]
        local = rows - first[frame]
        for a in range(len(rows)):
            for b in range(a + 1, len(rows)):
                if frame[a] != frame[b]:
                    pair = (int(frame[a]) // frame_stride, int(frame[b]) // frame_stride)
                    rows_of_pair.setdefault(pair, []).append((int(local[a]), int(local[b])))
    return Problem(
        frames=Frames(
            t_us=frames.t_us[kept],
            T_world_camera=frames.T_world_camera[kept],
            K=frames.K,
            width=frames.width,
            height=frames.height,
        ),
        segments_px=[observations.segments_px[first[i] : first[i + 1]] for i in kept],
        matches={pair: np.array(rows) for pair, rows in rows_of_pair.items()},
        neighbors=[],
    )


def tracks_of(tracks: LineTracks) -> Iterator[IntArray]:
    """Observations of each track, by frame."""
    for index in range(len(tracks)):
        yield np.sort(tracks[index]).astype(np.int64)


PROBLEMS = {"lsd": detected_problem, "own": own_problem}


def _frames(times_us: list[int], trajectory: Trajectory, camera: Camera) -> Frames:
    if not times_us:
        raise EventsError("events", "events around at least one frame", "none", reason="NO_EVENTS")
    return frames_at(np.array(times_us, np.int64), trajectory, camera)


def _tell(progress: ProgressCallback, done: int, total: int) -> None:
    progress(
        Progress(stage="limap", done_count=done, total_count=total, fraction=0.5 * done / total)
    )


def nearest_frames(frames: Frames, count: int) -> list[IntArray]:
    """For each frame the nearest others, by their centres, that look less than a field of view away.

    LIMAP asks for shared points, which event frames do not have.
    """
    centre = frames.T_world_camera.translation
    axis = frames.T_world_camera.rotation[:, :, 2]
    field_of_view_rad = 2.0 * np.arctan(0.5 * frames.width / frames.K[0, 0])
    distance_m = norm(centre[:, None] - centre[None])
    distance_m[axis @ axis.T < np.cos(field_of_view_rad)] = np.inf
    np.fill_diagonal(distance_m, np.inf)
    order = np.argsort(distance_m, axis=1, kind="stable")[:, :count]
    return [row[np.isfinite(distance_m[i, row])] for i, row in enumerate(order)]


def _pairs(neighbors: list[IntArray]) -> list[tuple[int, int]]:
    return sorted({(min(i, j), max(i, j)) for i, row in enumerate(neighbors) for j in row.tolist()})


def write_problem(path: Path, problem: Problem, settings: LimapSettings) -> None:
    """Write the arrays that `in_limap/map_lines.py` reads.

    Pixel centres are at integers in lines and calibration alike, which LIMAP does not mind.
    """
    pairs = sorted(problem.matches)
    matches = [problem.matches[pair] for pair in pairs]
    np.savez(
        path,
        **posed_images(problem.frames),
        segments_px=np.concatenate(problem.segments_px),
        line_offsets=_offsets(problem.segments_px),
        pairs=np.array(pairs, np.int64).reshape(-1, 2),
        matches=np.concatenate([np.empty((0, 2), np.int64), *matches]),
        match_offsets=_offsets(matches),
        neighbors=np.concatenate([np.empty(0, np.int64), *problem.neighbors]),
        neighbor_offsets=_offsets(problem.neighbors),
        options=json.dumps(worker_options(settings)),
    )


def posed_images(frames: Frames) -> dict[str, Any]:
    """The arrays that `in_limap/posed_images.py` reads."""
    T_camera_world, K = frames.T_world_camera.inverse(), frames.K
    return {
        "width": frames.width,
        "height": frames.height,
        "pinhole_px": np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]),
        "R_camera_world": T_camera_world.rotation,
        "t_camera_world": T_camera_world.translation,
    }


def _offsets(parts: list[Any]) -> IntArray:
    return np.cumsum([0, *(len(part) for part in parts)])


def worker_options(settings: LimapSettings) -> dict[str, Any]:
    """LIMAP's options of these settings, as JSON has them."""
    defaults = settings.defaults
    return {
        "triangulation": {"min_length_2d": settings.min_length_px, **defaults.triangulation},
        "linker3d": defaults.linker3d,
        "loss_scale_px": defaults.loss_scale_px,
        "loss_length_px": defaults.loss_length_px,
        "thread_count": os.cpu_count() or 1,
    }


def run_worker(command: list[str], timeout_s: float) -> None:
    """Run LIMAP's process; raises `NoAnswerError` if it fails or takes longer than `timeout_s`."""
    expected = "segments"
    try:
        done = subprocess.run(
            command,
            capture_output=True,
            text=True,
            errors="replace",
            timeout=timeout_s,
            check=False,
        )
    except subprocess.TimeoutExpired:
        found = f"nothing after {timeout_s:g} s"
        raise NoAnswerError("limap", expected, found, reason="PEER_TIMEOUT") from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1][:MAX_ERROR_LENGTH]
        found = f"exit code {done.returncode}: {last}"
        raise NoAnswerError("limap", expected, found, reason="PEER_FAILED")


def read_segments(path: Path) -> FloatArray:
    """(L, 2, 3) of the worker's answer; raises `NoAnswerError` for anything else."""
    expected = "finite segments (L, 2, 3)"
    if not path.exists():
        raise NoAnswerError("limap", expected, "no file", reason="PEER_FAILED")
    with np.load(path) as file:
        segments: Array = file["segments"]
    if segments.ndim != 3 or segments.shape[1:] != (2, 3) or not np.isfinite(segments).all():
        found = f"shape {segments.shape}, or values that are not finite"
        raise NoAnswerError("limap", expected, found, reason="PEER_FAILED")
    return np.asarray(segments, dtype=np.float64)


# Chosen by the IoU at 20 mm on room 12: every 6th, 3rd, 2nd and every
# frame 0.02, 0.08, 0.10 and 0.14 with a blur of 1.5 px; blurs of 1.5, 1.0, 0.7 and 0.5 px at every
# 2nd frame 0.10, 0.15, 0.15 and 0.17; together 0.22. Windows of 0.1 to 0.3 events a pixel
# and shortest lines of 7 to 15 px changed it by less than 0.01.
#
# The other rows say what each choice is worth. Exhaustive matching grows with the square of the
# lines, so it has fewer frames. Both flanks of each ridge, some 8 mm off, gain at 20 mm where the
# scene is near (0.35 against 0.26 on seed 102) and lose all at 5 mm. `own_lines` isolates
# triangulation and refinement from the front end.
_BEST = LimapSettings()
LIMAP_SETTINGS: dict[str, LimapSettings] = {
    "best_10": _BEST,
    "best_30": replace(_BEST, match_count=30),
    "exhaustive": replace(_BEST, match_count=0, frame_stride=2, neighbor_count=20),
    "limap_2": replace(_BEST, defaults=LIMAP_2),
    "not_compensated": replace(_BEST, compensate_rotation=False),
    "binary_raw": replace(_BEST, representation="binary", compensate_rotation=False, blur_px=1.5),
    "flanks": replace(_BEST, max_ridge_px=0.0),
    "every_3rd": replace(_BEST, frame_stride=3),
    "own_lines": replace(_BEST, lines="own"),
}
