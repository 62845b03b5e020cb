"""What the maps must reach, and whether the rows say that they do."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

from roel_bench.catalogue import REPORTING_ROOMS, TUNING_ROOMS
from roel_bench.disturbances import NOISY_POSES
from roel_bench.methods import PEERS
from roel_bench.results import NO_DISTURBANCE, Row
from roel_bench.suites import MAP
from roel_bench.tables import MISSING
from roel_bench.variants import DEFAULT_ABLATION, REFINED_POSES

LARGE, SMALL = "640x480", "346x260"
# LIMAP that finds its lines in event images, and LIMAP with this project's front end.
LIMAP_OWN_LINES = "LIMAP: own_lines"
LIMAP = tuple(name for name in PEERS if name.startswith("LIMAP") and name != LIMAP_OWN_LINES)


class Maps:
    """Rows of maps, and means over those of the rooms that count; errors are no rows."""

    def __init__(self, rows: Iterable[Row], *, with_tuning: bool) -> None:
        self._rooms = REPORTING_ROOMS + (TUNING_ROOMS if with_tuning else ())
        self._rows = {
            (row.scene, row.method, row.disturbance): row
            for row in rows
            if row.task == MAP and not row.error
        }

    def rows(
        self, method: str, sensor: str | None = None, disturbance: str = NO_DISTURBANCE
    ) -> dict[str, Row]:
        """Rows of a method by scene: of rooms of one sensor, or of all of them."""
        return {
            scene: row
            for (scene, name, disturbed), row in self._rows.items()
            if (name, disturbed) == (method, disturbance)
            and sensor in (None, row.sensor)
            and scene in self._rooms
        }

    def mean(
        self, figure: str, method: str, sensor: str | None = None, scenes: Iterable[str] = ()
    ) -> float | None:
        """Mean over the rooms, or over those of `scenes`; None without a figure."""
        rows = self.rows(method, sensor)
        chosen = [rows[scene] for scene in scenes] if scenes else list(rows.values())
        return _mean([row.figures.get(figure) for row in chosen])

    def ratio(
        self, figure: str, method: str, other: str, disturbance: str = NO_DISTURBANCE
    ) -> float | None:
        """Mean of a method over that of another one, on the rooms that both have been on.

        The disturbance is that of the first method's rows.
        """
        mine, theirs = self.rows(method, disturbance=disturbance), self.rows(other)
        both = [scene for scene in mine if scene in theirs]
        above = _mean([mine[scene].figures.get(figure) for scene in both])
        below = _mean([theirs[scene].figures.get(figure) for scene in both])
        return above / below if above is not None and below else None

    def best(self, figure: str, methods: Iterable[str]) -> str | None:
        """The method with the largest mean; None where none has been run."""
        means = {name: value for name in methods if (value := self.mean(figure, name)) is not None}
        return max(means, key=lambda name: means[name]) if means else None

    def scene(self, name: str, method: str) -> Row | None:
        """The undisturbed row of one scene."""
        return self._rows.get((name, method, NO_DISTURBANCE))


def _mean(values: list[float | int | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


@dataclass(frozen=True, kw_only=True)
class Criterion:
    """One number that is asked for.

    Attributes:
        what: in words.
        at_most, at_least: its bound; one of them is None, or both where it is only told.
        decimals: that it is told with.
        measure: the number, None where rows are missing.
    """

    what: str
    at_most: float | None = None
    at_least: float | None = None
    decimals: int = 2
    measure: Callable[[Maps], float | None]

    @property
    def bound(self) -> str:
        """What is asked for, in words."""
        if self.at_most is not None:
            return f"at most {self.at_most:g}"
        return MISSING if self.at_least is None else f"at least {self.at_least:g}"

    def holds(self, value: float) -> bool:
        """Whether a number is within the bound."""
        if self.at_most is not None:
            return value <= self.at_most
        return self.at_least is None or value >= self.at_least


def _mean_of(
    figure: str, words: str, sensor: str, method: str = "default", **bound: float
) -> Criterion:
    decimals = 1 if figure.endswith("_mm") else 3
    return Criterion(
        what=f"`{method}`, {sensor}: {words}",
        decimals=decimals,
        measure=lambda maps: maps.mean(figure, method, sensor),
        **bound,
    )


def _against_limap(figure: str) -> Callable[[Maps], float | None]:
    def measure(maps: Maps) -> float | None:
        best = maps.best("iou_20", LIMAP)
        return None if best is None else maps.ratio(figure, "default", best)

    return measure


def _ms_per_frame(maps: Maps) -> float | None:
    return _mean([row.ms_per_frame for row in maps.rows("default", LARGE).values()])


def _processor_ms_per_frame(maps: Maps) -> float | None:
    return _mean([row.processor_ms_per_frame for row in maps.rows("default", LARGE).values()])


def _paying_ablations(maps: Maps) -> float | None:
    """Share of the default's parts without which the mean IoU at 20 mm is lower."""
    ratios = [maps.ratio("iou_20", variant.name, "default") for variant in DEFAULT_ABLATION]
    return _mean([None if ratio is None else float(ratio < 1) for ratio in ratios])


def _covered_lines(figure: str) -> Callable[[Maps], float | None]:
    def measure(maps: Maps) -> float | None:
        row = maps.scene("events_room01", "default")
        return None if row is None else row.figures.get(figure)

    return measure


CRITERIA = (
    _mean_of("accuracy_mm", "accuracy, mm", LARGE, at_most=10),
    _mean_of("accuracy_median_mm", "median accuracy, mm", LARGE, at_most=3),
    _mean_of("completion_mm", "completion, mm", LARGE, at_most=55),
    _mean_of("iou_5", "IoU at 5 mm", LARGE, at_least=0.12),
    _mean_of("iou_10", "IoU at 10 mm", LARGE, at_least=0.22),
    _mean_of("iou_20", "IoU at 20 mm", LARGE, at_least=0.32),
    _mean_of("accuracy_mm", "accuracy, mm", SMALL, at_most=18),
    _mean_of("completion_mm", "completion, mm", SMALL, at_most=105),
    _mean_of("iou_5", "IoU at 5 mm", SMALL, at_least=0.10),
    _mean_of("iou_10", "IoU at 10 mm", SMALL, at_least=0.22),
    _mean_of("iou_20", "IoU at 20 mm", SMALL, at_least=0.33),
    _mean_of("accuracy_mm", "accuracy, mm", LARGE, "precise", at_most=5),
    _mean_of("accuracy_mm", "accuracy, mm", SMALL, "precise", at_most=5),
    Criterion(
        what="accuracy of `default` over that of `paper`",
        at_most=0.7,
        measure=lambda maps: maps.ratio("accuracy_mm", "default", "paper"),
    ),
    Criterion(
        what="IoU at 20 mm of `default` over that of `paper`",
        at_least=1.3,
        measure=lambda maps: maps.ratio("iou_20", "default", "paper"),
    ),
    Criterion(
        what="IoU at 20 mm of `default` over that of LIMAP's best configuration",
        at_least=3,
        measure=_against_limap("iou_20"),
    ),
    Criterion(
        what="the same over that of LIMAP with this project's lines",
        measure=lambda maps: maps.ratio("iou_20", "default", LIMAP_OWN_LINES),
    ),
    Criterion(
        what="median accuracy of `default` over that of LIMAP's best configuration",
        at_most=1,
        measure=_against_limap("accuracy_median_mm"),
    ),
    Criterion(
        what="accuracy of `default` over that of EMVS",
        at_most=0.2,
        measure=lambda maps: maps.ratio("accuracy_mm", "default", "EMVS"),
    ),
    Criterion(
        what="lines of `default` over points of EMVS",
        at_most=0.01,
        decimals=4,
        measure=lambda maps: maps.ratio("entity_count", "default", "EMVS"),
    ),
    Criterion(
        what="share of the default's parts that raise the mean IoU at 20 mm",
        at_least=1,
        measure=_paying_ablations,
    ),
    Criterion(
        what="IoU at 20 mm kept with 15 % noise events",
        at_least=0.9,
        measure=lambda maps: maps.ratio("iou_20", "default", "default", "noise_events"),
    ),
    Criterion(
        what="IoU at 20 mm kept with noisy poses",
        at_least=0.6,
        measure=lambda maps: maps.ratio("iou_20", "default", "default", NOISY_POSES),
    ),
    Criterion(
        what="the same with these poses refined",
        at_least=0.85,
        measure=lambda maps: maps.ratio("iou_20", REFINED_POSES.name, "default", NOISY_POSES),
    ),
    Criterion(
        what="`events_room01`: share of the true lines in the picture that are covered",
        at_least=0.85,
        measure=_covered_lines("covered_line_share"),
    ),
    Criterion(
        what="`events_room01`: the same of the true lines along which events fell",
        at_least=0.85,
        measure=_covered_lines("covered_active_line_share"),
    ),
    Criterion(
        what=f"`default`, {LARGE}: ms a frame", at_most=120, decimals=0, measure=_ms_per_frame
    ),
    Criterion(
        what=f"`default`, {LARGE}: processor ms a frame; two cores have 240 in 120 ms",
        at_most=240,
        decimals=0,
        measure=_processor_ms_per_frame,
    ),
)
