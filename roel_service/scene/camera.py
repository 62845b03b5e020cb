"""Camera models: what the calibration says, no projection code (see `geometry.projection`)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.errors import CameraError, PanoramaError
from roel_service.geometry.projection import CameraModel

__all__ = ["DISTORTION_COUNTS", "Camera", "CameraModel", "Equirectangular"]

# Coefficient counts that OpenCV defines: radial-tangential k1 k2 p1 p2 [k3 [k4 k5 k6]], and the
# equidistant model's k1..k4.
DISTORTION_COUNTS = {CameraModel.PINHOLE: (0, 4, 5, 8), CameraModel.FISHEYE: (4,)}


@dataclass(frozen=True, kw_only=True)
class Camera:
    """Intrinsics with OpenCV axes (x right, y down, z forward), pixel centres at integers.

    Attributes:
        width, height: px.
        fx_px, fy_px, cx_px, cy_px: focal lengths and principal point.
        model: radial-tangential pinhole or equidistant fisheye.
        distortion: OpenCV's coefficients, in OpenCV's order.

    Raises:
        CameraError: a size, focal length or number of coefficients that cannot be.
    """

    width: int
    height: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    model: CameraModel = CameraModel.PINHOLE
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            size = getattr(self, name)
            if not (isinstance(size, int) and not isinstance(size, bool) and 0 < size < 65536):
                raise CameraError("camera", f"{name} a positive integer below 65536", f"{size!r}")
        for name in ("fx_px", "fy_px"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise CameraError("camera", f"{name[:2]} finite and positive", f"{value!r}")
        for name in ("cx_px", "cy_px"):
            value = getattr(self, name)
            if not math.isfinite(value):
                raise CameraError("camera", f"{name[:2]} finite", f"{value!r}")
        counts = DISTORTION_COUNTS[self.model]
        if len(self.distortion) not in counts:
            wanted = " or ".join(str(count) for count in counts)
            raise CameraError(
                "camera",
                f"{wanted} distortion coefficients for model {self.model.value}",
                f"{len(self.distortion)}",
            )
        if not all(math.isfinite(value) for value in self.distortion):
            raise CameraError("camera", "finite distortion coefficients", f"{self.distortion}")

    @property
    def matrix(self) -> FloatArray:
        """(3, 3) calibration matrix K, px."""
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @property
    def focal_px(self) -> float:
        """Geometric mean of the two focal lengths."""
        return math.sqrt(self.fx_px * self.fy_px)


@dataclass(frozen=True, kw_only=True)
class Equirectangular:
    """A full panorama: x forward at the image centre, y left, z up.

    Attributes:
        width, height: px; width is twice the height.

    Raises:
        PanoramaError: other sizes.
    """

    width: int
    height: int

    def __post_init__(self) -> None:
        if not (self.height > 0 and self.width == 2 * self.height):
            found = f"{self.width} x {self.height}"
            raise PanoramaError("panorama", "a width of twice the height", found)
