"""Key reference views along a path: where a new local map begins, and what it sees.

EVO (Rebecq et al., RA-L 2017) begins a new map when the camera's distance from the last key view
exceeds a share of the mean scene depth. The poses are known here, so the reference view can stand
in the middle of its span, which EMVS (Rebecq et al., IJCV 2018) recommends for coverage and which
an online system cannot do.

Not in the papers: a span also ends when the optical axis has turned by a share of the field of
view, because a camera that turns on the spot would otherwise leave its map behind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from roel_service.errors import ConfigError
from roel_service.geometry.vectors import norm
from roel_service.scene.camera import Camera
from roel_service.scene.trajectory import Trajectory


@dataclass(frozen=True, kw_only=True)
class KeyframeSettings:
    """When the camera has gone far enough for a new key view.

    Attributes:
        distance_share: distance from the span's first pose over the mean scene depth.
        turn_share: turn of the optical axis over the horizontal field of view.
        min_baseline_share: a span that ends (with the poses, or by its turn) before this share of
            its distance gives no map, since its depths are not observable.
    """

    distance_share: float = 0.1
    turn_share: float = 0.5
    min_baseline_share: float = 0.3

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 <= value <= 10.0:
                raise ConfigError(f"keyframes.{name}", "between 0 and 10", f"{value}")


@dataclass(frozen=True, kw_only=True)
class Span:
    """A stretch of time whose events are seen from one reference view.

    Attributes:
        start_us, stop_us: half-open.
        baseline_m: largest distance of the camera from its first position.
        is_wide: whether the baseline suffices for depths.
    """

    start_us: int
    stop_us: int
    baseline_m: float
    is_wide: bool

    @property
    def reference_us(self) -> int:
        return (self.start_us + self.stop_us) // 2


def span_from(
    start_us: int,
    mean_depth_m: float,
    trajectory: Trajectory,
    camera: Camera,
    settings: KeyframeSettings,
) -> Span | None:
    """The span that begins at the first covered time not before `start_us`; None after the last.

    Args:
        start_us: earliest beginning.
        mean_depth_m: of the scene as the key view before saw it.
        trajectory, camera: poses and calibration.
        settings: thresholds.
    """
    for first_us, last_us in trajectory.covered_us().tolist():
        if start_us < last_us:
            return _span_within(
                max(start_us, first_us), last_us, mean_depth_m, trajectory, camera, settings
            )
    return None


def _span_within(
    start_us: int,
    last_us: int,
    mean_depth_m: float,
    trajectory: Trajectory,
    camera: Camera,
    settings: KeyframeSettings,
) -> Span:
    inside = trajectory.t_us[(trajectory.t_us > start_us) & (trajectory.t_us <= last_us)]
    poses = trajectory.interpolate(np.concatenate([[start_us], inside]))
    moved_m = norm(poses.translation - poses.translation[0])
    axes = poses.rotation[:, :, 2]
    turned_rad = np.arccos(np.clip(axes @ axes[0], -1.0, 1.0))
    limit_m = settings.distance_share * mean_depth_m
    ends = (moved_m > limit_m) | (turned_rad > settings.turn_share * _field_of_view_rad(camera))
    count = int(np.argmax(ends)) + 1 if ends.any() else len(ends)
    baseline_m = float(moved_m[:count].max())
    # Half-open, so the last pose's own time needs one microsecond more.
    stop_us = int(inside[count - 2]) if count < len(ends) else last_us + 1
    return Span(
        start_us=start_us,
        stop_us=stop_us,
        baseline_m=baseline_m,
        is_wide=baseline_m >= settings.min_baseline_share * limit_m,
    )


def _field_of_view_rad(camera: Camera) -> float:
    return float(2.0 * np.arctan(0.5 * camera.width / camera.fx_px))
