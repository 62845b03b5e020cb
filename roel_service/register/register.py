"""A line map onto a point cloud, by any of the methods."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.config.stages import RegisterConfig
from roel_service.errors import CloudError
from roel_service.geometry.se3 import SE3
from roel_service.register.point_to_point import align_points
from roel_service.register.prepare import PreparedCloud, prepare_cloud
from roel_service.register.source import Samples, sample_map
from roel_service.register.verdict import judge
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import RegistrationResult

METHODS = ("auto", "point", "plane", "line", "global")

# Two maps of one place differ in size, but not like this.
MAX_SIZE_RATIO = 100.0


def register_map(
    line_map: LineMap,
    cloud: PointCloud | PreparedCloud,
    config: RegisterConfig,
    *,
    method: str = "auto",
    T_init: SE3 | None = None,
) -> RegistrationResult:
    """Where a line map lies in a cloud.

    Args:
        line_map: the source.
        cloud: the target; prepare it once for many registrations.
        config: parameters.
        method: one of `METHODS`.
        T_init: first T_target_source; the identity by default.

    Raises:
        NoAnswerError: fewer than three lines.
        CloudError: a cloud in another unit than the map.
    """
    samples = sample_map(line_map, config.sample_spacing_m)
    if isinstance(cloud, PointCloud):
        require_same_unit(samples, cloud.points)
    target = cloud if isinstance(cloud, PreparedCloud) else prepare_cloud(cloud, config)
    require_same_unit(samples, target.points)
    alignment = align_points(
        samples.points,
        target.points,
        T_init or SE3.identity(),
        config.point_gate_m,
        config.point_iteration_count,
    )
    return judge(alignment, samples, target, config)


def require_same_unit(samples: Samples, points: FloatArray) -> None:
    """Refuse a cloud that is so much larger or smaller that its unit must be another one."""
    source_m, target_m = (float(np.ptp(p, axis=0).max()) for p in (samples.points, points))
    ratio = target_m / max(source_m, 1e-9)
    if 1.0 / MAX_SIZE_RATIO < ratio < MAX_SIZE_RATIO:
        return
    expected = f"a cloud in metres, as the map of {source_m:.3g} m is"
    found = f"a size of {target_m:.3g}"
    if abs(abs(np.log10(max(ratio, 1e-9))) - 3.0) < 1.0:
        unit = "millimetres and metres" if ratio > 1.0 else "metres and millimetres"
        found += f": a factor of about 1000, as between {unit}"
    raise CloudError("cloud", expected, found, reason="CLOUD_UNIT")
