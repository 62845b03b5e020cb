"""A small world with exact answers: a camera on a smooth path, and straight edges before it.

Everything is given for a world of size 1 m; `world(scale)` stretches lines and path alike, which
leaves all images as they are.
"""

import functools
from dataclasses import dataclass

import numpy as np

from roel_service.config.stages import FramesConfig
from roel_service.geometry import plucker, projection, segments
from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.mapping.evidence import measure_evidence
from roel_service.mapping.frames import EventFrame, Frames, frames_at
from roel_service.mapping.views import views_of
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSlice, EventStream
from roel_service.scene.lines import InfiniteLines, LineObservations, LineTracks
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=160, height=120, fx_px=120.0, fy_px=120.0, cx_px=79.5, cy_px=59.5)
DURATION_US = 2_000_000

# Twelve edges about the world's origin, 2 m before the camera; the first passes the origin.
SEGMENTS_WORLD = np.array(
    [
        [[-0.30, -0.12, 0.20], [0.30, 0.12, -0.20]],
        [[-0.80, -0.60, 0.30], [-0.10, -0.65, 0.50]],
        [[0.15, -0.62, 0.10], [0.85, -0.50, 0.60]],
        [[-0.90, -0.40, 0.00], [-0.85, 0.50, 0.20]],
        [[0.80, -0.35, -0.10], [0.78, 0.45, 0.10]],
        [[-0.75, 0.60, 0.20], [-0.05, 0.66, -0.10]],
        [[0.10, 0.62, 0.40], [0.75, 0.60, 0.10]],
        [[-0.60, -0.35, 0.30], [-0.55, 0.40, -0.20]],
        [[0.50, -0.40, -0.20], [0.48, 0.35, 0.30]],
        [[-0.40, -0.45, -0.10], [0.35, -0.38, 0.30]],
        [[-0.40, 0.48, 0.50], [0.35, 0.38, 0.10]],
        [[-0.30, 0.15, 0.60], [0.25, 0.30, 0.70]],
    ]
)

# Poses so dense that the motion between them is straight for all that is measured here.
POSE_STEP_US = 5_000
# An exact event lies at the middle of its slot when slots are this long.
EXACT_SLOT_US = 1
EXACT_FRAMES = FramesConfig(slot_us=EXACT_SLOT_US)


def path(t_us, scale=1.0, radius=1.0):
    """Poses on a loop some 0.5 m wide, looking at the origin with a slow turn of the head.

    Args:
        radius: share of the loop's width; 0 leaves a camera that only turns.
    """
    phase = 2 * np.pi * np.asarray(t_us) / DURATION_US
    centre = np.stack(
        [0.30 * np.sin(phase), 0.22 * np.cos(phase), 0.10 * np.sin(2 * phase)], axis=-1
    )
    centre = radius * centre + np.array([0.0, 0.0, -2.0])
    turn = np.stack(
        [0.05 * np.sin(phase + 1.0), 0.06 * np.cos(phase), 0.10 * np.sin(phase)], axis=-1
    )
    return SE3(rotation=rotation_from_vector(turn), translation=scale * centre)


def trajectory(scale=1.0, first_us=0, last_us=DURATION_US, radius=1.0):
    t_us = np.arange(first_us, last_us + 1, POSE_STEP_US)
    return Trajectory(t_us=t_us, T_world_camera=path(t_us, scale, radius))


@dataclass(frozen=True, kw_only=True)
class World:
    """Truth and what is seen of it; `line_of` tells the segment behind each observation."""

    segments: np.ndarray
    trajectory: Trajectory
    frames: Frames
    observations: LineObservations
    line_of: np.ndarray

    @property
    def lines(self):
        direction, moment = plucker.plucker_from_endpoints(self.segments)
        return InfiniteLines(direction=direction, moment=moment)

    @property
    def tracks(self):
        return LineTracks.from_rows(self.line_of, np.arange(len(self.line_of)), len(self.segments))

    @property
    def views(self):
        return views_of(self.observations, self.frames)

    def evidence(self, refine):
        # Poses at every microsecond take a while; without events nothing looks at them.
        frames_config = EXACT_FRAMES if refine.event_weight else FramesConfig()
        return measure_evidence(
            self.observations, self.frames, self.trajectory, frames_config, refine
        )


@functools.cache
def world(scale=1.0, frame_count=24, noise_px=0.0, event_noise_px=0.0, lines=tuple(range(12))):
    """Those of `SEGMENTS_WORLD` that `lines` names, as `world_of`."""
    truth = SEGMENTS_WORLD[list(lines)]
    return world_of(truth, scale, frame_count, noise_px, event_noise_px)


def world_of(segments_world, scale=1.0, frame_count=24, noise_px=0.0, event_noise_px=0.0):
    """Edges, seen in every frame in which they are wholly in the image.

    Args:
        noise_px: standard deviation of the observed ends, across the segment.
        event_noise_px: of the supporting events.
    """
    truth = scale * np.asarray(segments_world)
    poses = trajectory(scale)
    t_us = np.linspace(20_000, DURATION_US - 20_000, frame_count).astype(np.int64)
    frames = frames_at(t_us, poses, CAMERA)
    observations, line_of = observe(truth, poses, frames, noise_px, event_noise_px)
    return World(
        segments=truth, trajectory=poses, frames=frames, observations=observations, line_of=line_of
    )


def observe(truth, poses, frames, noise_px=0.0, event_noise_px=0.0, event_count=40):
    """Exact 2D lines with speeds and supporting events, and the segment behind each of them."""
    rng = np.random.default_rng(0)
    in_camera = frames.T_world_camera.inverse()[:, None, None] @ truth
    ends_px = projection.project(in_camera, frames.K)
    frame_of, line_of = np.nonzero(in_image(ends_px))
    ends_px = ends_px[frame_of, line_of]
    left = segments.left_normal(ends_px)
    # Nearest in time first, as the plane fit leaves them.
    dt_us = rng.integers(-250, 251, (len(frame_of), event_count))
    dt_us = np.take_along_axis(dt_us, np.argsort(np.abs(dt_us), axis=1, kind="stable"), axis=1)
    share = rng.random((*dt_us.shape, 1))
    points = truth[line_of, None, 0] + share * (truth[line_of, None, 1] - truth[line_of, None, 0])
    T_world_own = poses.interpolate((frames.t_us[frame_of, None] + dt_us).ravel())
    events_px = projection.project(T_world_own.inverse() @ points.reshape(-1, 3), frames.K)
    noise = noise_px * rng.standard_normal((len(frame_of), 2, 1))
    event_noise = event_noise_px * rng.standard_normal(events_px.shape)
    observations = LineObservations(
        frame=frame_of.astype(np.int32),
        segments_px=ends_px + noise * left[:, None],
        polarity=np.where(line_of % 2, 1, -1),
        normal_speed_px_per_ms=normal_speeds(
            ends_px, in_camera[frame_of, line_of], frame_of, poses, frames
        ),
        event_offsets=event_count * np.arange(len(frame_of) + 1),
        event_xy_px=(events_px + event_noise).astype(np.float32),
        event_dt_us=dt_us.ravel().astype(np.int32),
    )
    return observations, line_of


def in_image(ends_px):
    size_px = np.array([CAMERA.width - 1, CAMERA.height - 1])
    return ((ends_px >= 0) & (ends_px <= size_px)).all(axis=(-2, -1))


def points_at(segment, share, t_us, poses):
    """(n, 2) px of the points at these shares of a segment, seen at their own times."""
    points = segment[0] + np.asarray(share)[:, None] * (segment[1] - segment[0])
    return projection.project(poses.interpolate(t_us).inverse() @ points, CAMERA.matrix)


def normal_speeds(ends_px, ends_camera, frame_of, poses, frames):
    """(M,) px/ms of the middles of images of segments along their normals, the turn undone.

    A point at normalised (x, y) and depth z moves by f (x w_z - w_x, y w_z - w_y) / z a second
    when the camera moves by w (m/s, in its own axes).
    """
    before, after = (poses.interpolate(frames.t_us + step_us) for step_us in (-1_000, 1_000))
    velocity = (after.translation - before.translation) / 2e-3
    w = frames.T_world_camera.inverse().rotate(velocity)[frame_of]
    middle = projection.normalized_from_pixel(ends_px.mean(axis=1), frames.K)
    # The point of the segment that is seen at the middle of its image.
    depth_m = ends_camera[..., 2]
    share = depth_m[:, 0] / depth_m.sum(axis=1)
    middle_depth_m = depth_m[:, 0] + share * (depth_m[:, 1] - depth_m[:, 0])
    motion = frames.focal_px * (middle * w[:, 2:] - w[:, :2]) / middle_depth_m[:, None]
    return np.vecdot(segments.left_normal(ends_px), motion) * 1e-3


def frames_of(T_world_camera, step_us=10_000):
    """Frames of the camera at these poses."""
    return Frames(
        t_us=np.arange(len(T_world_camera)) * step_us,
        T_world_camera=T_world_camera,
        K=CAMERA.matrix,
        width=CAMERA.width,
        height=CAMERA.height,
    )


def still_frames(count, turn_rad=0.0):
    """A camera in one place that turns about its vertical axis by `turn_rad` a frame."""
    turn = np.arange(count)[:, None] * np.array([0.0, turn_rad, 0.0])
    return frames_of(SE3(rotation=rotation_from_vector(turn), translation=np.zeros((count, 3))))


def observed(*rows):
    """Observations from rows (frame, segment, polarity, speed); without events."""
    count = len(rows)
    return LineObservations(
        frame=np.array([row[0] for row in rows], np.int32),
        segments_px=np.array([row[1] for row in rows], float).reshape(-1, 2, 2),
        polarity=np.array([row[2] if len(row) > 2 else 1 for row in rows], np.int8),
        normal_speed_px_per_ms=np.array([row[3] if len(row) > 3 else 0.0 for row in rows]),
        event_offsets=np.zeros(count + 1, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )


def moving_line_events(
    segment_px,
    speed_px_per_ms,
    turn_per_ms=0.0,
    count=400,
    half_window_ms=10.0,
    polarity=1,
    noise_px=0.0,
    seed=0,
):
    """(count, 2) positions, (count,) times in us and polarities on one space-time plane."""
    rng = np.random.default_rng(seed)
    segment_px = np.asarray(segment_px, dtype=np.float64)
    t_us = np.sort(rng.integers(int(-1e3 * half_window_ms), int(1e3 * half_window_ms) + 1, count))
    on_line = segment_px[0] + rng.random(count)[:, None] * (segment_px[1] - segment_px[0])
    across = speed_px_per_ms * t_us * 1e-3 + noise_px * rng.standard_normal(count)
    xy_px = on_line + across[:, None] * segments.left_normal(segment_px)
    return xy_px, t_us, np.full(count, polarity, np.int8)


def event_frame_of(*parts, width=CAMERA.width, height=CAMERA.height, t_ref_us=0):
    """An `EventFrame` with sub-pixel positions, of one window."""
    xy_px = np.concatenate([np.asarray(part[0]).reshape(-1, 2) for part in parts])
    t_us = np.concatenate([part[1] for part in parts]).astype(np.int64)
    polarity = np.concatenate([part[2] for part in parts]).astype(np.int8)
    order = np.argsort(t_us, kind="stable")
    xy_px = xy_px[order].astype(np.float32)
    raw_px = np.zeros(len(xy_px), np.uint16)  # nothing behind the frame looks at raw pixels
    return EventFrame(
        events=EventSlice(
            t_us=t_us[order] + t_ref_us,
            x=raw_px,
            y=raw_px,
            polarity=polarity[order],
            t_ref_us=t_ref_us,
        ),
        ideal_px=xy_px,
        compensated_px=xy_px,
        windows=((0, len(xy_px)),),
        width=width,
        height=height,
    )


@functools.cache
def event_stream(scale=1.0, last_us=DURATION_US, radius=1.0):
    """Rounded events at random times along the moving edges, about one a px and 10 ms."""
    rng = np.random.default_rng(0)
    poses = trajectory(scale, radius=radius)
    columns = []
    for line, segment in enumerate(scale * SEGMENTS_WORLD):
        length_px = np.linalg.norm(
            np.diff(points_at(segment, [0.0, 1.0], np.array([0, 0]), poses), axis=0)
        )
        count = int(length_px * last_us / 10_000)
        t_us = rng.integers(0, last_us + 1, count)
        xy = np.rint(points_at(segment, rng.random(count), t_us, poses))
        inside = ((xy >= 0) & (xy < [CAMERA.width, CAMERA.height])).all(axis=1)
        polarity = np.full(count, 1 if line % 2 else -1)
        columns.append(np.column_stack([t_us, xy, polarity])[inside])
    t_us, x, y, polarity = np.concatenate(columns).T
    order = np.argsort(t_us, kind="stable")
    return EventStream(
        t_us=t_us[order].astype(np.int64),
        x=x[order].astype(np.uint16),
        y=y[order].astype(np.uint16),
        polarity=polarity[order].astype(np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )


def line_errors(lines, truth):
    """(L, 2) larger distance of the ends of true segments from the (L,) lines, and angle in rad."""
    feet = plucker.nearest_to_point(lines.direction[:, None], lines.moment[:, None], truth)
    true_direction, _ = plucker.plucker_from_endpoints(truth)
    sine = np.linalg.norm(np.cross(true_direction, lines.direction), axis=-1)
    distance_m = np.linalg.norm(feet - truth, axis=-1).max(axis=-1)
    return np.stack([distance_m, np.arcsin(np.minimum(sine, 1.0))], axis=-1)


def perturbed(lines, angle_rad, offset_m, seed=0):
    """Lines turned and moved by random amounts of these sizes."""
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(angle_rad * unit_rows(rng, len(lines)))
    direction = np.einsum("lij,lj->li", turn, lines.direction)
    point = plucker.nearest_to_origin(lines.direction, lines.moment)
    point = point + offset_m * unit_rows(rng, len(lines))
    return InfiniteLines(direction=direction, moment=plucker.moment_from_point(point, direction))


def unit_rows(rng, count):
    rows = rng.standard_normal((count, 3))
    return rows / np.linalg.norm(rows, axis=1, keepdims=True)
