"""The mapping of EL-SLAM (Chamorro, Sola and Andrade-Cetto, RA-L 2022): 3D lines per key view.

Its code was not published; this follows section III-B of the paper, as the RoEL paper's own
re-implementation did.

Taken from the paper: EMVS's volume in inverse depth, with its votes, adaptive threshold and median
filter; the Hough transform of the edge mask; merging of segments whose distance from the image
origin, angle and separation differ by less than 10 px, 10 degrees and 5 px m over the mean depth;
the principal direction of the edge pixels of a merged line, as points in space, after RANSAC; a
new key view when the camera has gone a share of the mean scene depth. As in the RoEL paper, poses
are known and the lines of all key views together are the map.

Left out: tracking, and the bundle adjustment, which corrects poses and lines of a few keyframes
together with the tracker's associations; there is no tracker here.

Not in the paper, filled in and tuned: the parameters of the Hough transform, which edge pixels
belong to a segment, RANSAC's distance (a share of the depth), and the least number and share of
its inliers. Lines are fitted in metres, not in the paper's pixels times depth, so that across and
along the image weigh the same. Ends are the outermost inliers.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from scipy.sparse.csgraph import connected_components

from roel_bench.peers.emvs import EmvsSettings, KeyView, key_views
from roel_service.arrays import Array, BoolArray, FloatArray
from roel_service.geometry.vectors import norm, unit
from roel_service.progress import ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.trajectory import Trajectory

# Steps of the Hough transform.
HOUGH_STEP_PX = 1.0
HOUGH_STEP_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, kw_only=True)
class ElSlamSettings:
    """Parameters of the extraction of lines from a key view.

    Attributes:
        emvs: the key views; its radius filter is not used.
        hough_vote_count, hough_length_px, hough_gap_px: least votes and length of a segment, and
            largest gap in it.
        merge_distance_px, merge_angle_deg, merge_gap_px_m: the paper's c1, c2 and c3; the last is
            divided by the mean depth.
        pixel_distance_px: edge pixels this close to a segment are its points.
        trial_count: random pairs of points a line.
        inlier_share: largest distance of an inlier from the line, over its depth.
        min_inlier_count, min_inlier_share: lines with fewer points, or fewer of theirs, are dropped.
        seed: of the trials.

    The defaults were chosen by the mean IoU at 20 mm on the tuning rooms: 0.194, against 0.171 and
    0.192 for gaps of 3 and 12 px in the Hough transform. Inliers of 0.005, 0.007, 0.015 and 0.02 of
    the depth, lengths of 10 and 20 px and stricter masks (offsets of 10 and 14) gave less.
    """

    emvs: EmvsSettings = field(default_factory=EmvsSettings)
    hough_vote_count: int = 15
    hough_length_px: float = 15.0
    hough_gap_px: float = 8.0
    merge_distance_px: float = 10.0
    merge_angle_deg: float = 10.0
    merge_gap_px_m: float = 5.0
    pixel_distance_px: float = 1.5
    trial_count: int = 64
    inlier_share: float = 0.01
    min_inlier_count: int = 15
    min_inlier_share: float = 0.5
    seed: int = 0


def map_segments(
    events: EventSource,
    trajectory: Trajectory,
    camera: Camera,
    settings: ElSlamSettings,
    progress: ProgressCallback = ignore,
) -> FloatArray:
    """The lines of all key views.

    Args:
        events: read once, front to back.
        trajectory, camera: poses and calibration.
        settings: parameters of every step.
        progress: called with each key view; may raise `Cancelled`.

    Returns:
        (L, 2, 3) segments, world, m.

    Raises:
        EventsError: no events.
        LimitError: a volume larger than `emvs.MAX_VOXEL_COUNT`.
    """
    rng = np.random.default_rng(settings.seed)
    segments = [np.empty((0, 2, 3))]
    for view in key_views(events, trajectory, camera, settings.emvs, progress):
        for found in view_segments(view, settings, rng):
            segments.append((view.T_world_camera @ found)[None])
    return np.concatenate(segments)


def view_segments(
    view: KeyView, settings: ElSlamSettings, rng: np.random.Generator
) -> list[FloatArray]:
    """(2, 3) segments, m, in the frame of a key view."""
    segments_px = hough_segments(view.mask, settings)
    mean_depth_m = float(view.depth_m[view.mask].mean())
    row, column = np.nonzero(view.mask)
    pixels = np.stack([column, row], axis=1).astype(np.float64)
    points = view.points_camera()
    segments = []
    for group in merged_groups(segments_px, mean_depth_m, settings):
        near = near_segments(pixels, segments_px[group], settings.pixel_distance_px)
        segment = fitted_segment(points[near], settings, rng)
        if segment is not None:
            segments.append(segment)
    return segments


def hough_segments(mask: BoolArray, settings: ElSlamSettings) -> FloatArray:
    """(S, 2, 2) segments, px, of the probabilistic Hough transform of an (H, W) mask."""
    found = cv2.HoughLinesP(
        mask.astype(np.uint8),
        HOUGH_STEP_PX,
        HOUGH_STEP_RAD,
        settings.hough_vote_count,
        minLineLength=settings.hough_length_px,
        maxLineGap=settings.hough_gap_px,
    )
    if found is None:
        return np.empty((0, 2, 2))
    return np.asarray(found, dtype=np.float64).reshape(-1, 2, 2)


def merged_groups(
    segments_px: FloatArray, mean_depth_m: float, settings: ElSlamSettings
) -> list[Array]:
    """Indices of the (S, 2, 2) segments that are parts of one line, a group a line."""
    if len(segments_px) == 0:
        return []
    direction = unit(segments_px[:, 1] - segments_px[:, 0])
    cosine = direction @ direction.T
    # Distances from the origin are signed by the normal; of antiparallel ones, one is turned round.
    origin_px = direction[:, 0] * segments_px[:, 0, 1] - direction[:, 1] * segments_px[:, 0, 0]
    origin_difference_px = np.abs(origin_px[:, None] - np.sign(cosine) * origin_px[None])
    max_gap_px = settings.merge_gap_px_m / mean_depth_m
    alike = (
        (origin_difference_px < settings.merge_distance_px)
        & (np.abs(cosine) > np.cos(np.deg2rad(settings.merge_angle_deg)))
        & (_gaps_px(segments_px, direction) < max_gap_px)
    )
    count, label = connected_components(alike, directed=False)
    return [np.flatnonzero(label == index) for index in range(count)]


def _gaps_px(segments_px: FloatArray, direction: FloatArray) -> FloatArray:
    """(S, S) separation along the first of two segments; 0 where they face each other."""
    along = np.einsum("ijex,ix->ije", segments_px[None] - segments_px[:, None, :1], direction)
    length_px = norm(segments_px[:, 1] - segments_px[:, 0])
    beyond = along.min(axis=2) - length_px[:, None]
    gaps_px = np.maximum(np.maximum(beyond, -along.max(axis=2)), 0.0)
    return np.asarray(np.minimum(gaps_px, gaps_px.T))


def near_segments(pixels: FloatArray, segments_px: FloatArray, distance_px: float) -> BoolArray:
    """(P,) which of (P, 2) pixels lie beside one of (S, 2, 2) segments, between its ends."""
    start = segments_px[:, 0]
    length_px = norm(segments_px[:, 1] - start)
    direction = unit(segments_px[:, 1] - start)
    offset = pixels[:, None] - start
    along = (offset * direction).sum(axis=-1)
    across = np.abs(offset[..., 0] * direction[:, 1] - offset[..., 1] * direction[:, 0])
    beside = (along >= 0.0) & (along <= length_px) & (across <= distance_px)
    return np.asarray(beside.any(axis=1))


def fitted_segment(
    points: FloatArray, settings: ElSlamSettings, rng: np.random.Generator
) -> FloatArray | None:
    """(2, 3) the line of most of (P, 3) points, as long as its inliers; None without enough."""
    if len(points) < max(2, settings.min_inlier_count):
        return None
    inliers = _consensus(points, settings, rng)
    enough = max(settings.min_inlier_count, settings.min_inlier_share * len(points))
    if inliers.sum() < enough:
        return None
    chosen = points[inliers]
    mean = chosen.mean(axis=0)
    direction = np.linalg.svd(chosen - mean, full_matrices=False)[2][0]
    along = (chosen - mean) @ direction
    return np.asarray(mean + np.array([[along.min()], [along.max()]]) * direction)


def _consensus(points: FloatArray, settings: ElSlamSettings, rng: np.random.Generator) -> BoolArray:
    """(P,) the largest set of points near the line of two of them."""
    pairs = rng.integers(0, len(points), (settings.trial_count, 2))
    pairs = pairs[pairs[:, 0] != pairs[:, 1]]
    start = points[pairs[:, 0]]
    direction = unit(points[pairs[:, 1]] - start)
    offset = points[None] - start[:, None]
    along = (offset * direction[:, None]).sum(axis=-1)
    distance_m = norm(offset - along[..., None] * direction[:, None])
    inliers = distance_m <= settings.inlier_share * points[:, 2]
    if len(inliers) == 0:
        return np.zeros(len(points), np.bool_)
    return np.asarray(inliers[inliers.sum(axis=1).argmax()])
