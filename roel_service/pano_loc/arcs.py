"""Straight edges of a picture, as arcs of great circles.

A straight line in space is an arc of a great circle on the sphere of viewing rays, but a curve in
the equirectangular picture. Lines are therefore looked for in overlapping perspective crops that
cover the sphere; their ends become rays, and from there on nothing knows of crops, seam or poles.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import lru_cache

import cv2
import numpy as np

from roel_service.arrays import Array, FloatArray, IntArray, frozen_array
from roel_service.config.stages import LocalizeConfig
from roel_service.geometry import sphere
from roel_service.geometry.vectors import dot, unit
from roel_service.pano_loc import arcs_kernels
from roel_service.pano_loc.side_by_side import side_by_side

# OpenCV's LSD at its default scale of 0.8 puts lines this far to the upper left (px).
LSD_OFFSET_PX = -0.125
BLUR_PX = 0.7
# Edges along the border of a crop are bent; the crop next to it has them whole.
BORDER_PX = 4.0
# Shorter detections have no direction to speak of.
MIN_PIECE_RAD = np.deg2rad(1.2)
# Pieces whose ends are this close to a longer piece's circle, with gaps no longer than this
# between them, are one line.
JOIN_DISTANCE_RAD = np.deg2rad(0.3)
JOIN_GAP_RAD = np.deg2rad(2.0)


@dataclass(frozen=True)
class Tiling:
    """Square perspective views that cover the sphere.

    Attributes:
        rings: elevation, degrees, and how many views look along evenly spaced azimuths there.
        field_of_view_deg: of each, in both directions.
    """

    rings: tuple[tuple[float, int], ...]
    field_of_view_deg: float


# Few views, which overlap by some degrees: looking for lines is most of the time of a query.
TILING = Tiling(((0.0, 6), (45.0, 5), (-45.0, 5), (90.0, 1), (-90.0, 1)), 66.0)


@dataclass(frozen=True, eq=False, kw_only=True)
class PanoramaArcs:
    """Arcs of great circles, each shorter than a half circle; longest first.

    Attributes:
        starts, ends: (A, 3) unit rays, panorama frame.
        normals: (A, 3) unit, along start x end.
        length_rad: (A,).
        sides: (V, 3) unit; a ray is in the picture if it is on the positive side of each. None for
            a panorama.
    """

    starts: FloatArray
    ends: FloatArray
    normals: FloatArray
    length_rad: FloatArray
    sides: FloatArray = field(default_factory=lambda: np.empty((0, 3)))

    def __post_init__(self) -> None:
        count = len(self.length_rad)
        for name in ("starts", "ends", "normals"):
            array = frozen_array(getattr(self, name), np.float64, (count, 3), name)
            object.__setattr__(self, name, array)
        length_rad = frozen_array(self.length_rad, np.float64, (count,), "length_rad")
        object.__setattr__(self, "length_rad", length_rad)
        sides = frozen_array(self.sides, np.float64, (None, 3), "sides")
        object.__setattr__(self, "sides", sides)

    def __len__(self) -> int:
        return len(self.length_rad)

    @staticmethod
    def between(starts: FloatArray, ends: FloatArray) -> PanoramaArcs:
        """The shorter arcs between (A, 3) unit rays."""
        cosine = np.clip(dot(starts, ends), -1.0, 1.0)
        order = np.argsort(cosine, kind="stable")
        normals = sphere.great_circle_normal(starts, ends)
        return PanoramaArcs(
            starts=starts[order],
            ends=ends[order],
            normals=normals[order],
            length_rad=np.arccos(cosine[order]),
        )

    def take(self, index: Array) -> PanoramaArcs:
        """The arcs of these indices, or of this mask, in that order."""
        return replace(
            self,
            starts=self.starts[index],
            ends=self.ends[index],
            normals=self.normals[index],
            length_rad=self.length_rad[index],
        )


def detect_arcs(grey: Array, config: LocalizeConfig) -> PanoramaArcs:
    """The straight edges of an (H, 2H) uint8 panorama."""
    grey = _limited(grey, config.max_width_px)
    padded = _padded(cv2.GaussianBlur(grey, (0, 0), BLUR_PX, borderType=cv2.BORDER_REPLICATE))

    def pieces_in(crop: Crop) -> FloatArray:
        view = cv2.remap(padded, crop.column_px, crop.row_px, cv2.INTER_LINEAR)
        pieces = detect_pieces(view)
        from_center_px = np.abs(pieces.mean(axis=1) - crop.center_px).max(axis=1)
        return crop.rays(pieces[from_center_px <= crop.center_px - BORDER_PX])

    rays = np.concatenate(side_by_side(pieces_in, crops(grey.shape[1], config.crop_px, TILING)))
    return whole_arcs(rays[:, 0], rays[:, 1], config)


def detect_pieces(view: Array) -> Array:
    """(P, 2, 2) ends, px, of straight edges in a perspective view."""
    lines = cv2.createLineSegmentDetector().detect(view)[0]
    return np.empty((0, 2, 2)) if lines is None else lines.reshape(-1, 2, 2) - LSD_OFFSET_PX


def whole_arcs(starts: FloatArray, ends: FloatArray, config: LocalizeConfig) -> PanoramaArcs:
    """The longest of the lines that (P, 3) unit rays are the ends of pieces of."""
    pieces = PanoramaArcs.between(starts, ends)
    arcs = join_arcs(pieces.take(pieces.length_rad >= MIN_PIECE_RAD))
    arcs = arcs.take(arcs.length_rad >= np.deg2rad(config.min_arc_deg))
    return arcs.take(np.arange(min(len(arcs), config.max_arc_count)))


def join_arcs(pieces: PanoramaArcs) -> PanoramaArcs:
    """Pieces of the same line joined, wherever they lie on the sphere.

    Args:
        pieces: longest first.
    """
    if len(pieces) == 0:
        return pieces
    group = arcs_kernels.join(
        pieces.starts, pieces.ends, pieces.normals, JOIN_DISTANCE_RAD, JOIN_GAP_RAD
    )
    # Group by group, the longest piece of each first.
    order = np.argsort(group, kind="stable")
    pieces, group = pieces.take(order), group[order]
    first = np.flatnonzero(np.diff(group, prepend=-1))
    middles = unit(pieces.starts + pieces.ends)
    normals = _fitted_normals(pieces, middles, first)
    # Angles along the circle, from the middle of the group's longest piece.
    ahead = unit(middles[first] - dot(middles[first], normals)[:, None] * normals)
    aside = np.cross(normals, ahead)
    rays = np.stack([pieces.starts, pieces.ends], axis=1)
    along_rad = np.arctan2(dot(rays, aside[group, None]), dot(rays, ahead[group, None]))
    low = np.minimum.reduceat(along_rad.min(axis=1), first)
    high = np.maximum.reduceat(along_rad.max(axis=1), first)
    short = high - low < np.pi
    starts, ends = (
        np.cos(angle)[:, None] * ahead + np.sin(angle)[:, None] * aside for angle in (low, high)
    )
    return PanoramaArcs.between(starts[short], ends[short])


def _fitted_normals(pieces: PanoramaArcs, middles: FloatArray, first: IntArray) -> FloatArray:
    """(G, 3) normals of the circles that fit the pieces of each group best.

    Args:
        pieces: group by group.
        middles: (A, 3) unit, of the pieces.
        first: (G,) index of the first piece of each group.
    """
    # Simpson's rule for the integral of q q' along the arc.
    rays = np.stack([pieces.starts, middles, pieces.ends], axis=1)
    weighted = (pieces.length_rad[:, None] * np.array([1.0, 4.0, 1.0]))[:, :, None] * rays
    scatter = np.add.reduceat(weighted.transpose(0, 2, 1) @ rays, first, axis=0)
    return np.asarray(np.linalg.eigh(scatter)[1][:, :, 0])


@dataclass(frozen=True, eq=False, kw_only=True)
class Crop:
    """A perspective view of a panorama.

    Attributes:
        R_panorama_camera: (3, 3), camera axes right, down, forward.
        focal_px, center_px: of both axes.
        column_px, row_px: (N, N) float32, where each pixel lies in the padded panorama.
    """

    R_panorama_camera: FloatArray
    focal_px: float
    center_px: float
    column_px: Array
    row_px: Array

    def rays(self, points_px: Array) -> FloatArray:
        """(*B, 3) unit rays, panorama frame, of (*B, 2) pixels."""
        across = (np.asarray(points_px, np.float64) - self.center_px) / self.focal_px
        camera = np.concatenate([across, np.ones_like(across[..., :1])], axis=-1)
        return unit(camera @ self.R_panorama_camera.T)


@lru_cache(maxsize=1)  # tables of some MB that depend on the size of the picture alone
def crops(width: int, size_px: int, tiling: Tiling) -> tuple[Crop, ...]:
    """The crops that cover a panorama of this width."""
    focal_px = 0.5 * size_px / np.tan(np.deg2rad(tiling.field_of_view_deg) / 2)
    center_px = (size_px - 1) / 2
    found = []
    for elevation_deg, count in tiling.rings:
        for azimuth_rad in np.arange(count) * (2.0 * np.pi / count):
            R = _looking_along(azimuth_rad, np.deg2rad(elevation_deg))
            blank = Crop(
                R_panorama_camera=R,
                focal_px=focal_px,
                center_px=center_px,
                column_px=np.empty(0),
                row_px=np.empty(0),
            )
            pixels = np.stack(np.meshgrid(*2 * [np.arange(size_px)]), axis=-1)
            place = sphere.pixel_from_ray(blank.rays(pixels), width, width // 2) + 1.0
            column_px, row_px = np.moveaxis(place.astype(np.float32), -1, 0)
            found.append(
                Crop(
                    R_panorama_camera=R,
                    focal_px=focal_px,
                    center_px=center_px,
                    column_px=np.ascontiguousarray(column_px),
                    row_px=np.ascontiguousarray(row_px),
                )
            )
    return tuple(found)


def _looking_along(azimuth_rad: float, elevation_rad: float) -> FloatArray:
    """(3, 3) R_panorama_camera of an upright camera."""
    c, s = np.cos(azimuth_rad), np.sin(azimuth_rad)
    forward = np.array(
        [np.cos(elevation_rad) * c, np.cos(elevation_rad) * s, np.sin(elevation_rad)]
    )
    right = np.array([s, -c, 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def _limited(grey: Array, max_width_px: int) -> Array:
    if grey.shape[1] <= max_width_px:
        return grey
    size = (max_width_px, max_width_px // 2)
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA))


def _padded(grey: Array) -> Array:
    """One pixel more on every side: columns wrap, rows go on across the pole."""
    half = grey.shape[1] // 2
    rows = np.concatenate([np.roll(grey[:1], half, 1), grey, np.roll(grey[-1:], half, 1)])
    return np.concatenate([rows[:, -1:], rows, rows[:, :1]], axis=1)
