"""Named sets of parameters."""

from __future__ import annotations

from roel_service.config.stages import (
    UNLIMITED,
    Config,
    DetectConfig,
    FramesConfig,
    MatchGlobalConfig,
    MatchLocalConfig,
    PlaneFitConfig,
    RefineConfig,
    RefineRoundsConfig,
    TriangulateConfig,
    TrimConfig,
)
from roel_service.errors import ConfigError

# Published values and choices; what the paper leaves open is marked in docs/paper_map.md.
PAPER = Config(
    frames=FramesConfig(rate_hz=100.0, compensate_rotation=False),
    detect=DetectConfig(
        representations=("binary", "timestamp"),
        merge_distance_px=2.0,
        merge_overlap=0.0,
        merge_across_polarities=True,
    ),
    plane_fit=PlaneFitConfig(
        method="ransac",
        candidate_distance_px=10.0,
        time_scale_px_per_ms=20.0,
        inlier_distance_px=2.0,
        support_event_count=100,
        support_half_window_us=25_000,
    ),
    match_local=MatchLocalConfig(predict=False, max_distance_px=10.0, min_overlap=0.0),
    match_global=MatchGlobalConfig(method="sampled", max_distances_px=(5.0,)),
    triangulate=TriangulateConfig(gate="grassmann", min_inlier_count=10, merge=True),
    refine=RefineConfig(
        residual="grassmann",
        loss="squared",
        loss_scale_px=0.7,
        event_weight=1e4,
        event_count_per_line=50,
        max_length_weight_px=UNLIMITED,
        direction_sigma_deg=0.0,
        corner_sigma_m=0.0,
        max_residual_px=20.0,
        min_inlier_count=10,
        pose_method="batch",
        pose_iteration_count=60,
    ),
    # What triangulation takes from here; the rest of its cost is its own.
    refine_rounds=RefineRoundsConfig(loss_scale_px=0.7, max_residual_px=20.0, min_inlier_count=10),
    # The paper has no such limit.
    trim=TrimConfig(method="cluster", max_error_m=UNLIMITED),
)

# Lines that the map can vouch for: what is left out is mostly right, but not surely.
PRECISE = Config(trim=TrimConfig(max_error_m=0.006))

PRESETS = {"default": Config(), "precise": PRECISE, "paper": PAPER}


def preset(name: str) -> Config:
    """The preset of that name; raises `ConfigError` for an unknown one."""
    if name not in PRESETS:
        raise ConfigError("preset", "one of " + ", ".join(PRESETS), name)
    return PRESETS[name]
