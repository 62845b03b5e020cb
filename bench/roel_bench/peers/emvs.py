"""Event-based Multi-View Stereo (Rebecq et al., IJCV 2018): events to semi-dense points.

A key view holds a disparity space image (DSI): a volume of votes over its pixels and planes of
equal steps in inverse depth. Every event is a ray and votes for the voxels it passes; edges lie
where many rays meet. Taken from the paper: the volume, the two-step back-projection with bilinear
votes (section 5.2), the largest votes along depth and adaptive Gaussian thresholding of them, the
median filter inside the mask and the radius filter of the points (section 5.3). The merged map is
the points of all key views together.

Where this differs: the homography goes to the farthest plane, not the nearest, since a camera may
move past the nearest one; poses change every `SLOT_US` instead of every few hundred events; key
views stand in the middle of their span and their number is known from the poses (`keyframes`).
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
from scipy.spatial import cKDTree

from roel_bench.peers import emvs_kernels
from roel_bench.peers.keyframes import KeyframeSettings, Span, span_from
from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.errors import ConfigError, EventsError, LimitError
from roel_service.geometry.projection import undistortion_table
from roel_service.geometry.se3 import SE3
from roel_service.in_order import in_order
from roel_service.progress import Progress, ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSlice, EventSource, EventStream
from roel_service.scene.trajectory import Trajectory

# One pose serves the events of so short a time: a fast turn of 5 rad/s moves 0.7 px in it.
SLOT_US = 300
# 2 GiB of votes; a caller's planes and sensor must fit.
MAX_VOXEL_COUNT = 2**29
# A camera closer to a plane than this share of the far plane's depth casts no vote on it.
MIN_PLANE_SHARE = 1e-3
# Planes are voted in blocks of this many, a block to a thread.
PLANE_BLOCK = 8


@dataclass(frozen=True, kw_only=True)
class EmvsSettings:
    """Parameters of the volume, of the depth map and of its points.

    Attributes:
        min_depth_m, max_depth_m: nearest and farthest plane.
        plane_count: planes, in equal steps of inverse depth.
        threshold_window_px: side of the Gaussian window of the adaptive threshold, odd.
        threshold_offset: how far the votes, scaled to 0-255, must exceed the window's mean.
        median_window_px: side of the median filter, odd; 1 switches it off.
        border_px: pixels along the border without depth, where windows are cut.
        neighbor_radius_m, min_neighbor_count: points with fewer others this near are dropped.
        keyframes: when a new key view begins.

    The defaults were chosen by the IoU at 20 mm on the tuning rooms, over 100 to 400 planes between
    0.5-6 and 0.8-5 m, windows of 5 to 15 px, offsets of 5 to 14 and key views every 7 to 40 % of
    the depth. On room 12 they give 0.27 with 88 mm of accuracy (0.40 and 24 mm on seed 102),
    where the paper's 100 planes gave 0.10. An offset of 14 halves the ghosts (12 mm on seed 102)
    and costs a quarter of the IoU there: `EMVS_SETTINGS["strict"]`.
    """

    min_depth_m: float = 0.7
    max_depth_m: float = 5.0
    plane_count: int = 400
    threshold_window_px: int = 7
    threshold_offset: float = 6.0
    median_window_px: int = 11
    border_px: int = 10
    neighbor_radius_m: float = 0.05
    min_neighbor_count: int = 3
    keyframes: KeyframeSettings = field(default_factory=KeyframeSettings)

    def __post_init__(self) -> None:
        _require("min_depth_m", self.min_depth_m > 0, "positive", self.min_depth_m)
        above = self.max_depth_m > self.min_depth_m
        _require("max_depth_m", above, f"above {self.min_depth_m}", self.max_depth_m)
        _require("plane_count", 2 <= self.plane_count <= 1024, "2 to 1024", self.plane_count)
        for name, least in (("threshold_window_px", 3), ("median_window_px", 1)):
            side = getattr(self, name)
            _require(name, side % 2 == 1 and least <= side <= 99, f"odd, {least} to 99", side)

    @property
    def plane_depths_m(self) -> FloatArray:
        """(Z,) depths of the planes, nearest first."""
        return np.asarray(
            1.0 / np.linspace(1.0 / self.min_depth_m, 1.0 / self.max_depth_m, self.plane_count)
        )


def _require(name: str, holds: bool, expected: str, found: float) -> None:
    if not holds:
        raise ConfigError(f"emvs.{name}", expected, f"{found}")


EMVS_SETTINGS = {"balanced": EmvsSettings(), "strict": EmvsSettings(threshold_offset=14.0)}


@dataclass(frozen=True, eq=False, kw_only=True)
class KeyView:
    """What a key view knows of the scene.

    Attributes:
        T_world_camera: its pose.
        K: (3, 3) calibration matrix, px.
        votes: (H, W) float32, the largest of each pixel.
        depth_m: (H, W) float64 median-filtered depths; valid inside the mask.
        mask: (H, W) bool, pixels that show an edge.
    """

    T_world_camera: SE3
    K: FloatArray
    votes: Array
    depth_m: FloatArray
    mask: BoolArray

    def points_camera(self) -> FloatArray:
        """(P, 3) m, the masked pixels in space."""
        row, column = np.nonzero(self.mask)
        xy_px = np.stack([column, row], axis=1).astype(np.float64)
        return unprojected(xy_px, self.depth_m[self.mask], self.K)


def unprojected(xy_px: FloatArray, depth_m: FloatArray, K: FloatArray) -> FloatArray:
    """(P, 3) points, camera frame, m, of (P, 2) pixels with (P,) depths."""
    rays = (xy_px - K[:2, 2]) / np.array([K[0, 0], K[1, 1]])
    return np.concatenate([rays * depth_m[:, None], depth_m[:, None]], axis=1)


def map_points(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: EmvsSettings,
    progress: ProgressCallback = ignore,
) -> FloatArray:
    """The semi-dense map of a recording.

    Args:
        events: read once, front to back; memory holds one chunk and one volume.
        trajectory, camera: poses and calibration.
        settings: parameters of every step.
        progress: called with each key view; may raise `Cancelled`.

    Returns:
        (P, 3) points, world, m.

    Raises:
        EventsError: no events.
        LimitError: more voxels than `MAX_VOXEL_COUNT`.
    """
    clouds = [np.empty((0, 3))]
    for view in key_views(events, trajectory, camera, settings, progress):
        points = view.T_world_camera @ view.points_camera()
        clouds.append(
            points[has_neighbors(points, settings.neighbor_radius_m, settings.min_neighbor_count)]
        )
    return np.concatenate(clouds)


def has_neighbors(points: FloatArray, radius_m: float, min_count: int) -> BoolArray:
    """(P,) whether at least `min_count` other points lie within a radius."""
    if len(points) == 0:
        return np.zeros(0, np.bool_)
    within = cKDTree(points).query_ball_point(points, radius_m, return_length=True)
    return np.asarray(within > min_count)  # the point itself is among them


def key_views(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: EmvsSettings,
    progress: ProgressCallback = ignore,
) -> Iterator[KeyView]:
    """Depth maps of all key views, in the order of time; arguments and errors as `map_points`."""
    next_span = partial(
        span_from, trajectory=trajectory, camera=camera, settings=settings.keyframes
    )
    volume = Volume(camera, trajectory, settings)
    mean_depth_m = float(np.sqrt(settings.min_depth_m * settings.max_depth_m))
    span: Span | None = None
    has_begun = False
    for chunk in events.chunks():
        if len(chunk) == 0:
            continue
        if not has_begun:
            span = next_span(int(chunk.t_us[0]), mean_depth_m)
            has_begun = True
        while span is not None:
            volume.add(chunk, span)
            if span.stop_us > chunk.t_us[-1]:
                break
            view = volume.take(span)
            if view is not None:
                mean_depth_m = float(view.depth_m[view.mask].mean())
                yield view
            _tell(progress, span.stop_us, trajectory)
            span = next_span(span.stop_us, mean_depth_m)
    if not has_begun:
        raise EventsError("events", "at least one event", "none", reason="NO_EVENTS")
    view = volume.take(span) if span is not None else None
    if view is not None:
        yield view


def _tell(progress: ProgressCallback, t_us: int, trajectory: Trajectory) -> None:
    """Progress by the time of the poses; the number of key views is not known before the last."""
    first_us, last_us = int(trajectory.t_us[0]), int(trajectory.t_us[-1])
    done_us = min(t_us, last_us) - first_us
    progress(
        Progress(
            stage="emvs",
            done_count=done_us,
            total_count=last_us - first_us,
            fraction=done_us / (last_us - first_us),
        )
    )


class Volume:
    """The disparity space image, filled and emptied once a span."""

    def __init__(self, camera: Camera, trajectory: Trajectory, settings: EmvsSettings) -> None:
        voxel_count = settings.plane_count * camera.width * camera.height
        if voxel_count > MAX_VOXEL_COUNT:
            raise LimitError(
                "emvs.plane_count", f"at most {MAX_VOXEL_COUNT} voxels", f"{voxel_count}"
            )
        self._settings = settings
        self._trajectory = trajectory
        self._K = camera.matrix
        self._ideal_px = undistortion_table(camera)
        self._depths_m = settings.plane_depths_m
        self._votes = np.zeros((settings.plane_count, camera.height, camera.width), np.float32)

    def add(self, chunk: EventStream, span: Span) -> None:
        """Vote for the events of a chunk that lie within a span; only wide spans are worth it."""
        events = chunk.between(span.start_us, span.stop_us)
        if span.is_wide and len(events):
            self._vote(events, self._reference(span))

    def take(self, span: Span) -> KeyView | None:
        """The key view of a span, None where nothing is seen; the volume is empty again."""
        if not span.is_wide:
            return None
        best = self._votes.argmax(axis=0)
        votes = np.take_along_axis(self._votes, best[None], axis=0)[0]
        self._votes.fill(0.0)
        mask = edge_mask(votes, self._settings)
        if not mask.any():
            return None
        plane = emvs_kernels.masked_median(best, mask, self._settings.median_window_px // 2)
        return KeyView(
            T_world_camera=self._reference(span),
            K=self._K,
            votes=votes,
            depth_m=self._depths_m[plane],
            mask=mask,
        )

    def _reference(self, span: Span) -> SE3:
        return self._trajectory.interpolate(np.array([span.reference_us]))[0]

    def _vote(self, events: EventSlice, T_world_reference: SE3) -> None:
        slot_number, slot = np.unique(events.t_us // SLOT_US, return_inverse=True)
        middles_us = slot_number * SLOT_US + SLOT_US // 2
        middles_us = np.clip(middles_us, self._trajectory.t_us[0], self._trajectory.t_us[-1])
        T_reference_slot = T_world_reference.inverse() @ self._trajectory.interpolate(middles_us)
        slot = slot.astype(np.int32)
        far_m = float(self._depths_m[-1])
        homographies = far_plane_homographies(T_reference_slot, self._K, far_m)
        far_px = np.empty((len(events), 2), np.float32)
        emvs_kernels.project_to_far_plane(
            self._ideal_px[events.y, events.x], slot, homographies, far_px
        )

        def vote_block(first: int) -> None:
            block = slice(first, first + PLANE_BLOCK)
            transfers = plane_transfers(
                T_reference_slot.translation, self._K, far_m, self._depths_m[block]
            )
            emvs_kernels.vote(far_px, slot, transfers.astype(np.float32), self._votes[block])

        blocks = range(0, len(self._votes), PLANE_BLOCK)
        for _ in in_order(vote_block, blocks, os.cpu_count() or 1):
            pass


def far_plane_homographies(T_reference_camera: SE3, K: FloatArray, far_m: float) -> FloatArray:
    """(S, 3, 3) maps of pixels to where their rays meet a plane of the reference view.

    The ray of x from the centre c has the direction d = R K^-1 x and meets the depth Z_0 at
    c + (Z_0 - c_z) d / d_z: a homogeneous pixel after multiplication by d_z, positive where the
    ray meets the plane at all.

    Args:
        T_reference_camera: (S) poses of the cameras in the reference view.
        K: (3, 3) calibration matrix, px.
        far_m: depth Z_0 of the plane, ahead of all cameras.
    """
    R, centre = T_reference_camera.rotation, T_reference_camera.translation
    ahead_m = far_m - centre[:, 2]
    onto_plane = ahead_m[:, None, None] * R + centre[:, :, None] * R[:, None, 2]
    return np.asarray(K @ onto_plane @ np.linalg.inv(K))


def plane_transfers(
    centre: FloatArray, K: FloatArray, far_m: float, depths_m: FloatArray
) -> FloatArray:
    """(Z, S, 3) (scale, x, y): pixel on a plane = scale * pixel on the far plane + (x, y).

    A ray from c through the far point P_0 meets the depth Z at c + s (P_0 - c) with
    s = (Z - c_z) / (Z_0 - c_z); its pixel, less the principal point, is
    (s Z_0 / Z) p_0 + (1 - s) f c_xy / Z. NaN where the plane is not ahead of the camera.

    Args:
        centre: (S, 3) camera centres in the reference view, m.
        K: (3, 3) calibration matrix, px.
        far_m: depth of the far plane.
        depths_m: (Z,) depths of the planes.
    """
    Z = depths_m[:, None]
    share = (Z - centre[:, 2]) / (far_m - centre[:, 2])
    scale = share * far_m / Z
    focal_px, principal_px = np.diag(K)[:2], K[:2, 2]
    drift = (1.0 - share)[..., None] * (focal_px * centre[:, :2]) / Z[..., None]
    offset = drift + principal_px * (1.0 - scale)[..., None]
    transfers = np.concatenate([scale[..., None], offset], axis=-1)
    transfers[share < MIN_PLANE_SHARE] = np.nan
    return np.asarray(transfers)


def edge_mask(votes: Array, settings: EmvsSettings) -> BoolArray:
    """(H, W) pixels whose votes exceed their neighbourhood's (adaptive Gaussian thresholding)."""
    scaled = (votes * (255.0 / max(float(votes.max()), 1.0))).astype(np.uint8)
    mask = cv2.adaptiveThreshold(
        scaled,
        1,
        cv2.ADAPTIVE_THRESH_GAUSSIAN_C,
        cv2.THRESH_BINARY,
        settings.threshold_window_px,
        -settings.threshold_offset,
    )
    inside = np.zeros(mask.shape, np.bool_)
    border = settings.border_px
    inside[border : mask.shape[0] - border, border : mask.shape[1] - border] = True
    return np.asarray((mask > 0) & inside)
