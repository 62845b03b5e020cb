"""Configurations that are compared: presets, what each stage of them is worth, the paper's tables."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from roel_service.config.load import Tables, with_tables
from roel_service.config.presets import PRESETS, preset
from roel_service.config.stages import CURVE_METHODS, UNLIMITED, Config
from roel_service.errors import ConfigError


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A preset with some values changed.

    Attributes:
        name: as the tables call it; unique.
        preset: what is changed.
        changes: values that differ, by table and key.
    """

    name: str
    preset: str = "default"
    changes: Tables = field(default_factory=dict)

    @property
    def config(self) -> Config:
        """Every effective value; raises `ConfigError` for a change that cannot be."""
        return with_tables(preset(self.preset), self.changes, subject=self.name)


def _without(what: str, **changes: dict[str, Any]) -> Variant:
    """The default with one thing switched off."""
    return Variant(name=f"default without {what}", changes=changes)


def _with(what: str, **changes: dict[str, Any]) -> Variant:
    """The default with one thing switched on."""
    return Variant(name=f"default with {what}", changes=changes)


def _refined(changes: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """The same for every refinement: between the rounds, and the last one."""
    return {"refine_rounds": changes, "refine": changes}


def _paper(name: str, **changes: dict[str, Any]) -> Variant:
    """The paper's pipeline with something changed."""
    return Variant(name=f"paper: {name}", preset="paper", changes=changes)


PRESET_VARIANTS = tuple(Variant(name=name, preset=name) for name in PRESETS)

# For recordings whose poses are an odometry's.
REFINED_POSES = Variant(name="default with refined poses", changes={"refine": {"free_poses": True}})

NO_PLANES = {"method": "none"}
NO_STEPS = {"iteration_count": 0}
NO_MERGING = {"merge_distance_px": 0.0}
NO_PLANE_FIT = _without("plane fit", plane_fit=NO_PLANES)

# One stage or rule of the default switched off at a time.
DEFAULT_ABLATION = (
    _without("corners", refine={"corner_sigma_m": 0.0}),
    _without(
        "rotation compensation",
        frames={"compensate_rotation": False},
        match_global={"max_speed_difference_px_per_ms": UNLIMITED},
    ),
    _without("second window", detect={"window_events_per_pixel": [0.2]}),
    _without("smoothing", detect={"blur_px": 0.0}),
    _without("merging of seeds", detect=NO_MERGING),
    NO_PLANE_FIT,
    _without(
        "speed vote (RANSAC planes)",
        plane_fit={
            "method": "ransac",
            "candidate_distance_px": 10.0,
            "inlier_distance_px": 2.0,
        },
    ),
    _without("density test", plane_fit={"min_density_ratio": 0.0}),
    _without("occupancy test", plane_fit={"min_occupancy": 0.0}),
    _without("prediction of matches", match_local={"predict": False}),
    _without("re-association", match_global={"method": "none"}),
    _without(
        "re-association (sampled matching)",
        match_global={"method": "sampled", "max_distances_px": [1.5]},
    ),
    _without("rounds of re-association", match_global={"max_distances_px": [1.5]}),
    _without("speed gate", match_global={"max_speed_difference_px_per_ms": UNLIMITED}),
    _without("one side of edges", match_global={"one_side": False}),
    _without("sharing rule", match_global={"max_shared_fraction": 1.0}),
    _without("event term", **_refined({"event_weight": 0.0})),
    _without("robust loss", **_refined({"loss": "squared"})),
    _without("shared directions", **_refined({"direction_sigma_deg": 0.0})),
    _without("refinement", **_refined(NO_STEPS)),
    _without("coverage runs (clustered ends)", trim={"method": "cluster"}),
    _without("end-on views left out", trim={"max_foreshortening": UNLIMITED}),
    _without("filter by the expected error", trim={"max_error_m": UNLIMITED}),
)

# What is off by default, switched on.
OFF_BY_DEFAULT = (_with("overlap removal", trim={"overlap_distance_m": 0.012}),)

# Curved edges, which the default leaves to its lines.
CURVE_VARIANTS = tuple(
    Variant(name=f"default with curves ({method})", changes={"curves": {"method": method}})
    for method in CURVE_METHODS
    if method != "none"
)

# The paper's pixel counts of its two windows are those of its data sets; these are ours.
WINDOWS = {"small": 0.1, "large": 0.3}
REPRESENTATIONS = ("binary", "timestamp")


def _single(window: str, representation: str) -> dict[str, Any]:
    """Detection on one image instead of several; no merging is needed."""
    return {
        "window_events_per_pixel": [WINDOWS[window]],
        "representations": [representation],
    }


SINGLES = tuple((window, name) for window in WINDOWS for name in REPRESENTATIONS)

# Rows of the paper's ablation table; its first row is the mean over the single predictions.
PAPER_ABLATION_SINGLES = tuple(
    _paper(
        f"{window} window, {name}, no planes, no refinement",
        detect=_single(window, name),
        plane_fit=NO_PLANES,
        refine=NO_STEPS,
    )
    for window, name in SINGLES
)
PAPER_ABLATION = (
    _paper("no planes, no refinement", plane_fit=NO_PLANES, refine=NO_STEPS),
    _paper("no refinement", refine=NO_STEPS),
    _paper(
        "LIMAP's cost",
        refine={
            "residual": "reprojection",
            "loss": "cauchy",
            "loss_scale_px": 1.0,
            "event_weight": 0.0,
        },
    ),
    _paper("line cost alone", refine={"event_weight": 0.0}),
)

# Readings of the paper that it leaves open.
PAPER_READINGS = (
    _paper("quartic cost", refine={"loss": "quartic"}),
    _paper("no global matching", match_global={"method": "none"}),
)

# Tables of single frames. "Planes" is the paper's pipeline up to its plane fit, i.e. the preset.
PAPER_PLANE_FITTING = (_paper("direct planes", plane_fit={"method": "direct"}),)
PAPER_DETECTION_SINGLES = tuple(
    _paper(f"{window} window, {name}, no planes", detect=_single(window, name), plane_fit=NO_PLANES)
    for window, name in SINGLES
)
PAPER_DETECTION = (
    _paper("no planes, no merging", detect=NO_MERGING, plane_fit=NO_PLANES),
    _paper("no planes", plane_fit=NO_PLANES),
)
PAPER_WINDOW_SIZES = tuple(
    _paper(
        f"windows x {label}, no planes",
        # The bounds in time would undo what the counts are changed by.
        frames={
            "min_half_window_us": max(200, round(6_000 * min(1.0, factor))),
            "max_half_window_us": round(25_000 * max(1.0, factor)),
        },
        detect={"window_events_per_pixel": [factor * size for size in WINDOWS.values()]},
        plane_fit=NO_PLANES,
    )
    for label, factor in (("1/10", 0.1), ("1/5", 0.2), ("5", 5.0), ("10", 10.0))
)
PAPER_REPRESENTATIONS = tuple(
    _paper(
        f"{' + '.join(names)}, no planes",
        detect={"representations": list(names)},
        plane_fit=NO_PLANES,
    )
    for names in (
        ("binary", "tos"),
        ("timestamp", "tos"),
        ("binary", "sits"),
        ("timestamp", "sits"),
    )
)
PAPER_VELOCITY_INVARIANT = tuple(
    _paper(f"{name} alone, no planes", detect={"representations": [name]}, plane_fit=NO_PLANES)
    for name in ("tos", "sits")
)
# Parameters of the plane fit, halved and doubled.
PAPER_PARAMETERS = (
    *(
        _paper(f"time scale {value:g}", plane_fit={"time_scale_px_per_ms": value})
        for value in (10.0, 40.0)
    ),
    *(
        _paper(f"inlier distance {value:g} px", plane_fit={"inlier_distance_px": value})
        for value in (1.0, 4.0)
    ),
    *(
        _paper(f"candidate distance {value:g} px", plane_fit={"candidate_distance_px": value})
        for value in (5.0, 20.0)
    ),
)
# N_e changes no line of a frame, but what the map is refined with.
PAPER_EVENT_COUNTS = tuple(
    _paper(
        f"N_e {count}",
        plane_fit={"support_event_count": count},
        refine={"event_count_per_line": count // 2},
    )
    for count in (50, 200)
)

MAP_ABLATION = (
    *DEFAULT_ABLATION,
    *OFF_BY_DEFAULT,
    *PAPER_ABLATION_SINGLES,
    *PAPER_ABLATION,
    *PAPER_READINGS,
    *PAPER_EVENT_COUNTS,
)
FRONT_END_VARIANTS = (
    *PRESET_VARIANTS,
    NO_PLANE_FIT,
    *PAPER_PLANE_FITTING,
    *PAPER_DETECTION_SINGLES,
    *PAPER_DETECTION,
    *PAPER_WINDOW_SIZES,
    *PAPER_REPRESENTATIONS,
    *PAPER_VELOCITY_INVARIANT,
    *PAPER_PARAMETERS,
)

VARIANTS = {
    variant.name: variant
    for variant in (
        *PRESET_VARIANTS,
        REFINED_POSES,
        *MAP_ABLATION,
        *CURVE_VARIANTS,
        *FRONT_END_VARIANTS,
    )
}


def find_variant(name: str) -> Variant:
    """The variant of that name; raises `ConfigError` for an unknown one."""
    if name not in VARIANTS:
        raise ConfigError("variant", "a name of docs/accuracy.md or a preset", name)
    return VARIANTS[name]
