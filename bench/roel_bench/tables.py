"""Rows as Markdown tables."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from roel_bench.results import Results, Row
from roel_bench.suites import FRONT_END, MAP
from roel_service.io.files import whole_file

# Columns of a map's table: heading, figure, decimals.
MAP_COLUMNS = (
    ("lines or points", "entity_count", 0),
    ("accuracy, mm", "accuracy_mm", 1),
    ("median, mm", "accuracy_median_mm", 1),
    ("completion, mm", "completion_mm", 0),
    ("IoU 5", "iou_5", 3),
    ("IoU 10", "iou_10", 3),
    ("IoU 20", "iou_20", 3),
    ("precision 20", "precision_20", 2),
    ("recall 20", "recall_20", 2),
)
# What recordings have that know no surfaces.
RECORDING_COLUMNS = (
    ("true lines covered", "covered_line_share", 2),
    ("held-back events explained", "held_back_explained_share", 2),
)
# What rooms of round things have beside the others.
CURVE_COLUMNS = (
    ("round: points", "curved_edge_count", 0),
    ("recall 5", "curved_recall_5", 3),
    ("recall 10", "curved_recall_10", 3),
    ("recall 20", "curved_recall_20", 3),
    ("precision 20", "curved_precision_20", 3),
    ("offset, mm", "curved_offset_median_mm", 1),
    ("completion, mm", "curved_completion_mm", 0),
    ("straight: recall 20", "straight_recall_20", 3),
)
FRAME_COLUMNS = (
    ("lines a frame", "lines_per_frame", 0),
    ("precision", "precision", 3),
    ("recall", "recall", 3),
    ("F-score", "f_score", 3),
    ("F at 2 px", "f_score_2px", 3),
    ("F slow", "f_score_slow", 3),
    ("F fast", "f_score_fast", 3),
    ("offset, px", "offset_median_px", 2),
    ("bias, px", "bias_along_motion_px", 2),
    ("explained events", "explained_event_share", 2),
    ("CPU ms a frame", "ms_per_frame", 0),
)
Column = tuple[str, str, int]
MISSING = "-"


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A Markdown table, or a word where it would have no row."""
    rows = list(rows)
    if not rows:
        return "Not run."
    lines = [headings, ["---"] * len(headings), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def number(value: float | None, decimals: int) -> str:
    """A figure with so many decimals, or a dash where there is none."""
    return MISSING if value is None else f"{value:.{decimals}f}"


def mean(rows: Iterable[Row], figure: str) -> float | None:
    """Mean of a figure over the rows that have it; None where none has."""
    values = [v for row in rows if (v := row.figures.get(figure)) is not None]
    return sum(values) / len(values) if values else None


def figure_cells(rows: Sequence[Row], columns: Sequence[Column]) -> list[str]:
    """Means over some rows, a cell a column."""
    return [number(mean(rows, figure), decimals) for _, figure, decimals in columns]


def all_rows(results: Results) -> str:
    """Every row of a run, maps first."""
    maps = results.select(lambda row: row.task == MAP)
    round_things = [row for row in maps if "curved_edge_count" in row.figures]
    frames = results.select(lambda row: row.task == FRONT_END)
    blocks = (
        _block("Maps", maps, (*MAP_COLUMNS, *RECORDING_COLUMNS)),
        _block("Round edges", round_things, CURVE_COLUMNS),
        _block("Lines of single frames", frames, FRAME_COLUMNS),
    )
    return "\n".join(block for block in blocks if block)


def _block(title: str, rows: Sequence[Row], columns: Sequence[Column]) -> str:
    """A headed table with a line a row; nothing where there are no rows."""
    if not rows:
        return ""
    headings = ["scene", "disturbance", "method", *(name for name, _, _ in columns)]
    cells = (
        [row.scene, row.disturbance, _method_cell(row), *figure_cells([row], columns)]
        for row in rows
    )
    return f"## {title}\n\n{table(headings, cells)}\n"


def failures(rows: Iterable[Row]) -> str:
    """Rows that hold an error in place of figures, a sentence each; empty where there are none."""
    return " ".join(
        f"{row.method} has no map of {row.scene}: {row.error}." for row in rows if row.error
    )


def _method_cell(row: Row) -> str:
    return f"{row.method} (**{row.error}**)" if row.error else row.method


def write_text(path: Path, text: str) -> None:
    """Write a text file that is whole or not there."""
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
