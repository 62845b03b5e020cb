"""A camera followed through rooms that were mapped on another walk: `python -m roel_bench.tracking`.

`follow` begins 20 cm and 10 degrees off and follows the whole walk; `start` does so for a moment, from
many places of the walk; `silence` leaves out a second of the events; `jump` leaves out a third of a second, then a
second, also of the clock, as if the camera had been put somewhere else at once; `elsewhere` follows the walk in the map of another room. A pose that is told as TRACKING is
wrong when it is more than 5 cm or 2 degrees off. Maps are read as `roel map export` writes them (.npz).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from roel_bench.results import this_machine
from roel_bench.tables import table
from roel_service.arrays import FloatArray
from roel_service.config.stages import TrackConfig
from roel_service.geometry.se3 import SE3
from roel_service.io.camera import read_camera
from roel_service.io.events import open_events
from roel_service.io.files import whole_file
from roel_service.io.maps import read_exported_map
from roel_service.io.poses import read_trajectory
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource, EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseStatus, TrackedPose
from roel_service.scene.trajectory import Trajectory
from roel_service.tracking.tracker import FINDING_HALF_US, PoseTracker
from roel_service.tracking.warm import warm_up

FORMAT = "roel tracking benchmark 1"
WRONG_M, WRONG_DEG = 0.05, 2.0
# A pose that is this near was found.
FOUND_M, FOUND_DEG = 0.02, 1.0
START_COUNT, START_US = 10, 600_000
JUMP_BEGIN_US, JUMP_US = 1_000_000, (300_000, 1_000_000)
SILENCE_BEGINS_US, SILENCE_US = (1_000_000, 1_500_000), 1_000_000
ELSEWHERE_US = 2_000_000
# Events come in pieces of so many.
PIECE_EVENT_COUNT = 30_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Walk:
    """A recording with its true poses, and the map of the same room from another one."""

    name: str
    events: EventSource
    camera: Camera
    trajectory: Trajectory
    line_map: LineMap


@dataclass(frozen=True, kw_only=True)
class Trial:
    """One run of the tracker.

    Attributes:
        walk, map, kind, seed: what was run.
        pose_count, tracking_count, lost_count: poses told, and those of two statuses.
        wrong_count: poses told as TRACKING that are wrong.
        median_deg, median_mm, p95_deg, p95_mm, worst_deg, worst_mm: errors of all poses but lost
            ones; null without any.
        nees: mean over TRACKING poses of the squared error against the covariance; 6 where it is honest.
        found_s: time until a pose was TRACKING and near the truth; after the cut for `silence` and `jump`.
        processor_ms: processor time of a pose, in the mean.
        following_ms, searching_ms: time by the clock of a pose that is told, and of one that is LOST:
            median, 95 % and the largest; null without any. Events that complete no pose count for the
            next one.
    """

    walk: str
    map: str
    kind: str
    seed: int
    pose_count: int
    tracking_count: int
    lost_count: int
    wrong_count: int
    median_deg: float | None
    median_mm: float | None
    p95_deg: float | None
    p95_mm: float | None
    worst_deg: float | None
    worst_mm: float | None
    nees: float | None
    found_s: float | None
    processor_ms: float
    following_ms: tuple[float, float, float] | None
    searching_ms: tuple[float, float, float] | None


def open_walk(folder: Path, map_path: Path) -> Walk:
    """A recording laid out as `roel simulate` does, with a map."""
    camera = read_camera(folder / "camera.json")
    return Walk(
        name=folder.name,
        events=open_events(folder / "events.h5", camera.width, camera.height),
        camera=camera,
        trajectory=read_trajectory(folder / "poses.txt"),
        line_map=read_exported_map(map_path),
    )


def farthest_guess(pose: SE3, config: TrackConfig, rng: np.random.Generator) -> SE3:
    """A first pose that is as far off as it may be."""
    turn, shift = (axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3)))
    return pose.retract(
        np.concatenate([np.deg2rad(config.reach_deg) * turn, config.reach_m * shift])
    )


def pieces(
    events: EventSource,
    first_us: int,
    last_us: int,
    cut_us: tuple[int, int] | None = None,
    *,
    clock_stops: bool = False,
) -> Iterator[tuple[EventStream, int]]:
    """Events between two times in small pieces, but for those of a cut.

    Args:
        clock_stops: events after the cut are told as so much earlier.

    Yields:
        Events on the clock of the tracker, and how far that clock is behind then.
    """
    for chunk in events.chunks():
        if chunk.t_us[-1] < first_us:
            continue
        for begin in range(0, len(chunk), PIECE_EVENT_COUNT):
            piece = chunk.part(begin, min(begin + PIECE_EVENT_COUNT, len(chunk)))
            if cut_us is None:
                yield _between(piece, first_us, last_us), 0
                continue
            yield _between(piece, first_us, cut_us[0]), 0
            behind_us = cut_us[1] - cut_us[0] if clock_stops else 0
            yield _earlier(_between(piece, cut_us[1], last_us), behind_us), behind_us
        if chunk.t_us[-1] >= last_us:
            return


def _between(events: EventStream, first_us: int, last_us: int) -> EventStream:
    begin, end = np.searchsorted(events.t_us, [first_us, last_us])
    return events.part(int(begin), int(end))


def _earlier(events: EventStream, by_us: int) -> EventStream:
    return EventStream(
        t_us=events.t_us - by_us,
        x=events.x,
        y=events.y,
        polarity=events.polarity,
        width=events.width,
        height=events.height,
    )


def trial(
    walk: Walk,
    line_map: LineMap,
    map_name: str,
    kind: str,
    seed: int,
    span_us: tuple[int, int],
    cut_us: tuple[int, int] | None = None,
) -> Trial:
    """Follow a walk, or a part of it, and compare with the truth."""
    config = TrackConfig()
    first = walk.trajectory.interpolate(np.array([span_us[0] + FINDING_HALF_US]))[0]
    guess = farthest_guess(first, config, np.random.default_rng(seed))
    tracker = PoseTracker(line_map, walk.camera, config, guess, seed)
    told: list[tuple[TrackedPose, int]] = []
    busy_s = pending_s = 0.0
    following_s: list[float] = []
    searching_s: list[float] = []
    for events, behind_us in pieces(walk.events, *span_us, cut_us, clock_stops=kind == "jump"):
        began_s, at_s = time.process_time(), time.perf_counter()
        poses = tracker.push(events)
        busy_s += time.process_time() - began_s
        pending_s += time.perf_counter() - at_s
        for pose in poses:
            is_lost = pose.status is PoseStatus.LOST
            (searching_s if is_lost else following_s).append(pending_s / len(poses))
        pending_s = 0.0 if poses else pending_s
        # A pose whose events are of both sides of the cut belongs to before it.
        told += [
            (
                pose,
                pose.t_us
                + (behind_us if cut_us and pose.t_us > cut_us[0] + config.interval_us // 2 else 0),
            )
            for pose in poses
        ]
    errors, squares = _errors(walk.trajectory, told)
    is_wrong = (errors[:, 0] > WRONG_DEG) | (errors[:, 1] > 1e3 * WRONG_M)
    is_near = (errors[:, 0] < FOUND_DEG) & (errors[:, 1] < 1e3 * FOUND_M)
    is_told = np.array([pose.status is PoseStatus.TRACKING for pose, _ in told])
    at_us = np.array([t_us for _, t_us in told])
    since_us = span_us[0] if cut_us is None else cut_us[1]
    found = at_us[is_told & is_near & (at_us >= since_us)]
    quantiles = _quantiles(errors)
    return Trial(
        walk=walk.name,
        map=map_name,
        kind=kind,
        seed=seed,
        pose_count=len(told),
        tracking_count=int(is_told.sum()),
        lost_count=sum(pose.status is PoseStatus.LOST for pose, _ in told),
        wrong_count=int((is_told & is_wrong).sum()),
        **quantiles,
        nees=round(float(np.mean(squares[is_told])), 2) if is_told.any() else None,
        found_s=round((int(found[0]) - since_us) * 1e-6, 3) if len(found) else None,
        processor_ms=round(1e3 * busy_s / max(1, len(told)), 2),
        following_ms=_spread_ms(following_s),
        searching_ms=_spread_ms(searching_s),
    )


def _spread_ms(seconds: Sequence[float]) -> tuple[float, float, float] | None:
    """Median, 95 % and largest."""
    if not seconds:
        return None
    median, p95, worst = (round(1e3 * float(np.quantile(seconds, q)), 1) for q in (0.5, 0.95, 1.0))
    return median, p95, worst


def _errors(
    trajectory: Trajectory, told: Sequence[tuple[TrackedPose, int]]
) -> tuple[FloatArray, FloatArray]:
    """(N, 2) degrees and mm, and (N,) normalised squares; infinite for lost poses."""
    errors, squares = np.full((len(told), 2), np.inf), np.full(len(told), np.inf)
    for row, (pose, t_us) in enumerate(told):
        if pose.T_world_camera is None or pose.covariance is None:
            continue
        step = pose.T_world_camera.local(trajectory.interpolate(np.array([t_us]))[0])
        turn_rad, shift_m = np.linalg.norm(step.reshape(2, 3), axis=1)
        errors[row] = np.rad2deg(turn_rad), 1e3 * shift_m
        squares[row] = step @ np.linalg.solve(pose.covariance, step)
    return errors, squares


def _quantiles(errors: FloatArray) -> dict[str, float | None]:
    finite = errors[np.isfinite(errors[:, 0])]
    named = {"median": 0.5, "p95": 0.95, "worst": 1.0}
    result: dict[str, float | None] = {}
    for name, share in named.items():
        for column, unit in enumerate(("deg", "mm")):
            value = round(float(np.quantile(finite[:, column], share)), 4) if len(finite) else None
            result[f"{name}_{unit}"] = value
    return result


def trials(walk: Walk, elsewhere: Sequence[tuple[str, LineMap]], kinds: set[str]) -> list[Trial]:
    """All trials of one walk."""
    first_us, last_us = (int(t_us) for t_us in walk.trajectory.t_us[[0, -1]])
    own = walk.line_map, walk.name
    rows = []
    if "follow" in kinds:
        rows.append(trial(walk, *own, "follow", 0, (first_us, last_us)))
    if "start" in kinds:
        for seed, begin in enumerate(np.linspace(first_us, last_us - START_US, START_COUNT)):
            rows.append(trial(walk, *own, "start", seed, (int(begin), int(begin) + START_US)))
    if "jump" in kinds:
        begin_us = first_us + JUMP_BEGIN_US
        for seed, jump_us in enumerate(JUMP_US):
            cut_us = (begin_us, begin_us + jump_us)
            rows.append(trial(walk, *own, "jump", seed, (first_us, last_us), cut_us))
    if "silence" in kinds:
        for seed, begin_us in enumerate(first_us + after_us for after_us in SILENCE_BEGINS_US):
            cut_us = (begin_us, begin_us + SILENCE_US)
            rows.append(trial(walk, *own, "silence", seed, (first_us, last_us), cut_us))
    if "elsewhere" in kinds:
        span_us = (first_us, first_us + ELSEWHERE_US)
        for seed, (name, line_map) in enumerate(elsewhere):
            rows.append(trial(walk, line_map, name, "elsewhere", seed, span_us))
    return rows


def as_table(rows: Sequence[Trial]) -> str:
    """The trials as Markdown."""
    header = ["walk", "map", "kind", "poses", "TRACKING", "LOST", "wrong", "median deg, mm"]
    header += ["p95 deg, mm", "worst deg, mm", "NEES", "found s", "processor ms"]
    header += ["following ms", "searching ms"]
    return table(header, [_cells(row) for row in rows])


def _cells(row: Trial) -> list[str]:
    pairs = [
        (row.median_deg, row.median_mm),
        (row.p95_deg, row.p95_mm),
        (row.worst_deg, row.worst_mm),
    ]
    errors = ["" if deg is None or mm is None else f"{deg:.3f}, {mm:.1f}" for deg, mm in pairs]
    counts = [row.pose_count, row.tracking_count, row.lost_count, row.wrong_count]
    last = [row.nees, row.found_s, row.processor_ms]
    told = ["" if value is None else f"{value:g}" for value in last]
    spreads = (row.following_ms, row.searching_ms)
    times = ["" if each is None else ", ".join(f"{ms:.0f}" for ms in each) for each in spreads]
    return [row.walk, row.map, row.kind, *map(str, counts), *errors, *told, *times]


def main() -> None:
    """Run what the command line names, and write and print its rows."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--walk", action="append", nargs=2, required=True, metavar=("DIR", "MAP.npz")
    )
    parser.add_argument("--elsewhere", action="append", default=[], metavar="MAP.npz")
    parser.add_argument(
        "--kinds", nargs="+", default=["follow", "start", "silence", "jump", "elsewhere"]
    )
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")
    options = parser.parse_args()
    warm_up()
    others = [(Path(name).stem, read_exported_map(Path(name))) for name in options.elsewhere]
    rows: list[Trial] = []
    for folder, map_name in options.walk:
        walk = open_walk(Path(folder), Path(map_name))
        rows += trials(walk, others, set(options.kinds))
        print(as_table(rows), flush=True)
    here = this_machine()
    head = {"format": FORMAT, "machine": here.machine, "versions": here.versions}
    with whole_file(options.out) as temporary:
        document = head | {"trials": [asdict(row) for row in rows]}
        temporary.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
