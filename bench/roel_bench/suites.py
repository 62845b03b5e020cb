"""Which methods run on which scenes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from roel_bench.catalogue import (
    CURVED_ROOMS,
    LARGE_ROOMS,
    POSED_RECORDINGS,
    POSELESS_RECORDINGS,
    REPORTING_ROOMS,
    SMALL_ROOMS,
    TINY_ROOM,
    TUNING_ROOMS,
)
from roel_bench.disturbances import DISTURBANCES, NOISY_POSES
from roel_bench.methods import PEERS, find_method
from roel_bench.results import NO_DISTURBANCE, front_end_digest
from roel_bench.variants import (
    CURVE_VARIANTS,
    FRONT_END_VARIANTS,
    MAP_ABLATION,
    PRESET_VARIANTS,
    REFINED_POSES,
    Variant,
    find_variant,
)
from roel_service.errors import InputError

MAP, FRONT_END = "map", "front_end"

# The tables of single frames have many rows, and the paper's are of one scene.
FRONT_END_ROOMS = LARGE_ROOMS[:1] + SMALL_ROOMS[:1]
PRESET_NAMES = tuple(variant.name for variant in PRESET_VARIANTS)
# Maps that are drawn; of an ablation's one sees nothing.
DRAWN_METHODS = (*PRESET_NAMES, *PEERS, *(variant.name for variant in CURVE_VARIANTS))


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One run: a task on a disturbed scene by a method."""

    task: str
    scene: str
    method: str
    disturbance: str = NO_DISTURBANCE

    @property
    def key(self) -> tuple[str, ...]:
        """The key of the row that it gives."""
        return (self.task, self.scene, self.disturbance, self.method)


def current_digest(task: str, method: str) -> str:
    """Of every parameter of a method, as its rows carry it; `ConfigError` for an unknown one."""
    if task == FRONT_END:
        return front_end_digest(find_variant(method).config)
    return find_method(method).digest


def _cells(
    task: str, scenes: Iterable[str], methods: Iterable[str], disturbance: str = NO_DISTURBANCE
) -> list[Cell]:
    methods = list(methods)
    return [
        Cell(task=task, scene=scene, method=method, disturbance=disturbance)
        for scene in scenes
        for method in methods
    ]


def _names(variants: Iterable[Variant]) -> list[str]:
    return [variant.name for variant in variants]


PRESETS_SUITE = [
    *_cells(MAP, TUNING_ROOMS + REPORTING_ROOMS + POSED_RECORDINGS, PRESET_NAMES),
    *_cells(FRONT_END, POSELESS_RECORDINGS, PRESET_NAMES),
]
ABLATION_SUITE = _cells(MAP, REPORTING_ROOMS, ["default", "paper", *_names(MAP_ABLATION)])
NOISE_SUITE = [
    *_cells(MAP, REPORTING_ROOMS, ["default"]),
    *(cell for name in DISTURBANCES for cell in _cells(MAP, REPORTING_ROOMS, ["default"], name)),
    *_cells(MAP, REPORTING_ROOMS, [REFINED_POSES.name], NOISY_POSES),
]
FRONT_END_SUITE = _cells(FRONT_END, FRONT_END_ROOMS, _names(FRONT_END_VARIANTS))
PEERS_SUITE = _cells(MAP, TUNING_ROOMS + REPORTING_ROOMS, ["default", *PEERS])
CURVES_SUITE = _cells(MAP, CURVED_ROOMS, ["default", *_names(CURVE_VARIANTS)])
QUICK_SUITE = [
    *_cells(MAP, [TINY_ROOM], PRESET_NAMES),
    *_cells(MAP, [TINY_ROOM], ["default"], "noise_events"),
    *_cells(FRONT_END, [TINY_ROOM], ["default", "paper"]),
]

SUITES = {
    "quick": QUICK_SUITE,
    "presets": PRESETS_SUITE,
    "ablation": ABLATION_SUITE,
    "noise": NOISE_SUITE,
    "front-end": FRONT_END_SUITE,
    "peers": PEERS_SUITE,
    "curves": CURVES_SUITE,
    "full": [
        *PRESETS_SUITE,
        *NOISE_SUITE,
        *PEERS_SUITE,
        *FRONT_END_SUITE,
        *ABLATION_SUITE,
        *CURVES_SUITE,
    ],
}


def select(
    suite: str, scenes: tuple[str, ...] | None = None, methods: tuple[str, ...] | None = None
) -> list[Cell]:
    """The cells of a suite, each once and scene by scene.

    Args:
        suite: one of `SUITES`.
        scenes: only these; one that the suite does not know gets whatever the others get.
        methods: only these; ones that the suite does not know make maps of all its scenes.

    Raises:
        InputError: no suite of that name.
    """
    if suite not in SUITES:
        raise InputError("suite", "one of " + ", ".join(SUITES), suite)
    cells = list(dict.fromkeys(SUITES[suite]))
    own_scenes = tuple(dict.fromkeys(cell.scene for cell in cells))
    if methods is not None:
        known = {cell.method for cell in cells}
        new = [method for method in methods if method not in known]
        cells = [cell for cell in cells if cell.method in methods] + _cells(MAP, own_scenes, new)
    return [cell for scene in scenes or own_scenes for cell in _of_scene(cells, scene)]


def _of_scene(cells: list[Cell], scene: str) -> list[Cell]:
    """The cells of one scene; for a new scene, those of all scenes with its name instead."""
    own = [cell for cell in cells if cell.scene == scene]
    return own or list(dict.fromkeys(replace(cell, scene=scene) for cell in cells))
