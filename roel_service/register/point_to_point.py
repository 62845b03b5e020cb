"""Method `point`, the paper's: point-to-point ICP of points along the lines, by Open3D."""

from __future__ import annotations

import numpy as np

from roel_service.arrays import FloatArray
from roel_service.geometry.se3 import SE3
from roel_service.register.alignment import Alignment
from roel_service.scene.results import StopReason

# Changes of fitness and rmse, relative, below which Open3D stops; its own defaults.
RELATIVE_CHANGE = 1e-6


def align_points(
    source: FloatArray, target: FloatArray, T_init: SE3, gate_m: float, iteration_count: int
) -> Alignment:
    """Iterate closest points from a first guess.

    Args:
        source: (P, 3) m, source frame.
        target: (N, 3) m, target frame.
        T_init: first T_target_source.
        gate_m: pairs farther apart do not count.
        iteration_count: at most so many iterations; Open3D does not tell how many it took.
    """
    import open3d  # seconds to load, so only where it is asked for

    registration = open3d.pipelines.registration
    clouds = [
        open3d.geometry.PointCloud(open3d.utility.Vector3dVector(p)) for p in (source, target)
    ]

    def iterate(T: FloatArray, count: int) -> tuple[FloatArray, float, float]:
        found = registration.registration_icp(
            *clouds,
            gate_m,
            T,
            registration.TransformationEstimationPointToPoint(),
            registration.ICPConvergenceCriteria(RELATIVE_CHANGE, RELATIVE_CHANGE, count),
        )
        return np.asarray(found.transformation), found.fitness, found.inlier_rmse

    T, fitness, rmse = iterate(T_init.matrix(), iteration_count)
    # Open3D does not tell why it stopped: one more iteration does.
    _, more_fitness, more_rmse = iterate(T, 1)
    settled = abs(more_fitness - fitness) + abs(more_rmse - rmse) < 2.0 * RELATIVE_CHANGE
    reason = StopReason.CONVERGED if settled else StopReason.ITERATION_LIMIT
    if fitness == 0.0:
        reason = StopReason.NO_OVERLAP
    left, _, right = np.linalg.svd(T[:3, :3])  # Open3D's product of many rotations drifts
    T_target_source = SE3(rotation=left @ right, translation=T[:3, 3])
    return Alignment(T_target_source=T_target_source, stop_reason=reason, iteration_count=None)
