"""LIMAP's bundle adjustment with everything held but the lines."""

from __future__ import annotations

from limap.estimators import bundle_adjustment


def lines_alone() -> bundle_adjustment.PointLineBundleAdjustmentOptions:
    """LIMAP's options; nothing of points, calibration and poses is free, and nothing is printed."""
    options = bundle_adjustment.PointLineBundleAdjustmentOptions()
    for name in (
        "refine_points",
        "refine_points3D",
        "refine_focal_length",
        "refine_principal_point",
        "refine_extra_params",
        "refine_rig_from_world",
        "refine_sensor_from_rig",
        "print_summary",
    ):
        setattr(options, name, False)
    return options
