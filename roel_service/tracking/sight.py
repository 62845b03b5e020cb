"""What a camera sees when nobody knows where it is: lines of one moment, and how fast it turns.

Lines and their speeds are found in the events as they are. The speeds tell a turn that moves the
picture as the camera does, its shift being taken for a turn; with that undone, the events of a
longer time make twice as many lines.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import DetectConfig, FramesConfig, PlaneFitConfig
from roel_service.geometry import segments
from roel_service.geometry.projection import normalized_from_pixel
from roel_service.geometry.se3 import SE3
from roel_service.mapping.detect import EDLines, Seeds, detect_lines
from roel_service.mapping.frames import EventFrame, event_frame
from roel_service.mapping.plane_fit import FittedLines, fit_space_time_planes
from roel_service.mapping.representations import event_images
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.trajectory import Trajectory
from roel_service.tracking.fit import View
from roel_service.tracking.pieces import MapPieces

# One window, a short one while nothing undoes the motion. However fast the camera moves, it has no
# more events than that.
MIN_HALF_WINDOW_US = 1_500
BLURRED_FRAMES = FramesConfig(compensate_rotation=False, min_half_window_us=MIN_HALF_WINDOW_US)
SHARP_FRAMES = FramesConfig(min_half_window_us=MIN_HALF_WINDOW_US)
BLURRED_DETECT = DetectConfig(window_events_per_pixel=(0.1,))
SHARP_DETECT = DetectConfig(window_events_per_pixel=(0.2,))
# Nobody asks for the events of a line: the fewest are gathered.
PLANES = PlaneFitConfig(support_event_count=1, support_half_window_us=1)
# So many lines are enough to tell a turn, and a place: planes are fitted to no more.
TURN_LINE_COUNT, PLACE_LINE_COUNT = 40, 100
# A turn is taken to be even for so long around a moment.
EVEN_US = 100_000
# Speeds of lines are known about so well; a camera turns about so fast.
SPEED_NOISE_PX_S, TURN_SIGMA_RAD_S = 60.0, 2.0
ROBUST_STEP_COUNT = 8
# What the two steps of a sharp look take at 640x480, about.
SEEDS_MS, PLANES_MS = 22.0, 20.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Eyes:
    """What turns events into lines, and where lines are looked for.

    Attributes:
        camera: calibration.
        ideal_px: (H, W, 2) undistortion table.
        view: calibration of the ideal picture.
        pieces: of the map.
    """

    camera: Camera
    ideal_px: Array
    view: View
    pieces: MapPieces


@dataclass(frozen=True, eq=False, kw_only=True)
class Sight:
    """What the events around one moment show.

    Attributes:
        lines: with their speeds in the picture.
        turn_rate: (3,) rad/s, in camera axes, that moves the picture as the camera does.
    """

    lines: FittedLines
    turn_rate: FloatArray


def glimpse(events: EventStream, t_us: int, eyes: Eyes) -> Sight:
    """Lines as they are in the events, and the turn that they tell."""
    seeds, frame = _seeds(events, t_us, eyes, np.zeros(3), BLURRED_FRAMES, BLURRED_DETECT)
    lines = _planes(seeds, frame, TURN_LINE_COUNT)
    return Sight(lines=lines, turn_rate=_turn_rate(lines, eyes.view))


def looking(
    events: EventStream, t_us: int, eyes: Eyes, turn_rate: FloatArray
) -> Generator[float, None, Sight]:
    """Lines once a turn is undone; before each step, about how many ms it takes."""
    yield SEEDS_MS
    seeds, frame = _seeds(events, t_us, eyes, turn_rate, SHARP_FRAMES, SHARP_DETECT)
    yield PLANES_MS
    lines = _planes(seeds, frame, PLACE_LINE_COUNT)
    undone_px_ms = 1e-3 * _speeds_by_turn(lines.segments_px, eyes.view) @ turn_rate
    lines = replace(lines, normal_speed_px_per_ms=lines.normal_speed_px_per_ms + undone_px_ms)
    return Sight(lines=lines, turn_rate=turn_rate)


def _seeds(
    events: EventStream,
    t_us: int,
    eyes: Eyes,
    turn_rate: FloatArray,
    frames: FramesConfig,
    detect: DetectConfig,
) -> tuple[Seeds, EventFrame]:
    frame = event_frame(
        events, t_us, eyes.ideal_px, _turning(t_us, turn_rate), eyes.camera, frames, detect
    )
    return detect_lines(event_images(frame, detect), EDLines(detect), detect), frame


def _planes(seeds: Seeds, frame: EventFrame, most: int) -> FittedLines:
    """The longest lines, with their planes."""
    # The longest come first.
    longest = Seeds(segments_px=seeds.segments_px[:most], polarity=seeds.polarity[:most])
    # The planes are voted for: nothing is drawn.
    return fit_space_time_planes(longest, frame, PLANES, np.random.default_rng(0))


def _turning(t_us: int, turn_rate: FloatArray) -> Trajectory:
    """A camera that turns evenly on the spot."""
    here = SE3(rotation=np.eye(3), translation=np.zeros(3))
    steps = np.array([-1.0, 0.0, 1.0])[:, None] * 1e-6 * EVEN_US * turn_rate
    poses = here.retract(np.concatenate([steps, np.zeros((3, 3))], axis=1))
    return Trajectory(t_us=t_us + np.array([-EVEN_US, 0, EVEN_US]), T_world_camera=poses)


def _turn_rate(lines: FittedLines, view: View) -> FloatArray:
    """(3,) rad/s that explains the speeds of most lines (Cauchy's loss, by length)."""
    by_turn = _speeds_by_turn(lines.segments_px, view)
    speed_px_s = 1e3 * lines.normal_speed_px_per_ms
    length_px = segments.length(lines.segments_px)
    certainty = length_px / (
        max(1.0, float(length_px.sum()) / max(1, len(length_px))) * SPEED_NOISE_PX_S**2
    )
    turn_rate = np.zeros(3)
    for _ in range(ROBUST_STEP_COUNT):
        off = (by_turn @ turn_rate - speed_px_s) / SPEED_NOISE_PX_S
        rows = (certainty / (1.0 + np.square(off)))[:, None] * by_turn
        information = rows.T @ by_turn + np.eye(3) / TURN_SIGMA_RAD_S**2
        turn_rate[:] = np.linalg.solve(information, rows.T @ speed_px_s)
    return turn_rate


def _speeds_by_turn(segments_px: FloatArray, view: View) -> FloatArray:
    """(M, 3) speeds px/s of lines along their left normals, by a turn of the camera of 1 rad/s."""
    u, v = normalized_from_pixel(segments_px.mean(axis=1), view.K).T
    along_u = np.stack([u * v, -(1.0 + u * u), v], axis=1) * view.K[0, 0]
    along_v = np.stack([1.0 + v * v, -u * v, -u], axis=1) * view.K[1, 1]
    normal = segments.left_normal(segments_px)
    return np.asarray(normal[:, :1] * along_u + normal[:, 1:] * along_v)
