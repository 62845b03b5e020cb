"""The measured part of `docs/localization.md`: `python -m roel_bench.localization_report`.

What stands outside the two marks in the page is written by hand.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from roel_bench.localization import (
    COARSE_DEG,
    COARSE_M,
    ELSEWHERE,
    FINE_DEG,
    FINE_M,
    HERE,
    MOVED,
    PRIOR,
    Cell,
    Results,
    Trial,
    read_results,
)
from roel_bench.localization_places import HOUSE, HOUSE_OUTSIDE, HOUSE_ROOM, ROOM, SYMMETRIC
from roel_bench.tables import MISSING, number, table, write_text
from roel_service.io.files import read_input

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "bench" / "results" / "localization.json"
DOCUMENT = ROOT / "docs" / "localization.md"
MAX_PAGE_BYTES = 1 << 20
BEGIN = "<!-- measured: written by roel_bench.localization_report -->\n"
END = "<!-- end of what was measured -->\n"

ANCHOR = "fgpl"
FOUND, AMBIGUOUS, NOT_FOUND = "FOUND", "AMBIGUOUS", "NOT_FOUND"

INTRODUCTION = f"""\
Generated from `bench/results/localization.json`, which `roel bench localization` wrote; a test holds the two
together. Maps are built from events by preset `default`; panoramas are 2048x1024, every fourth one tilted by up to
20 degrees. `fgpl` is FGPL as published, `fgpl-released` with what its released code does otherwise. `fine` is the
share within {FINE_M:g} m and {FINE_DEG:g} degrees, `coarse` that within {COARSE_M:g} m and {COARSE_DEG:g} degrees, of the best pose whatever its
status; no panorama is left out, and none without a pose counts as right. Medians are over all answers with a pose. Places marked * were looked at
when parameters were chosen; the others were not.
"""


def page(results: Results, text: str) -> str:
    """The page with its measured part replaced."""
    head, _, rest = text.partition(BEGIN)
    _, _, tail = rest.partition(END)
    return head + BEGIN + measured(results) + END + tail


def measured(results: Results) -> str:
    """All tables."""
    machine = results.machine
    versions = ", ".join(f"{name} {version}" for name, version in results.versions.items())
    told = (
        f"{machine['processor']}, {machine['core_count']} cores, {machine['system']}, Python"
        f" {machine['python']}; {versions}. Seconds are those of the processor, one thread.\n"
    )
    cells = results.cells
    return "\n".join(
        [
            INTRODUCTION,
            told,
            "### Rooms mapped from events\n",
            _success_table(_of(cells, (ROOM,), HERE)),
            "\n### The same maps, turned and shifted\n",
            MOTIONS,
            _motion_table(cells),
            "\n### Verdicts\n",
            VERDICTS,
            _verdict_table(cells),
            "\n### Symmetric rooms\n",
            SYMMETRY,
            _symmetry_table(_of(cells, (SYMMETRIC,), HERE)),
            "\n### Photographs of a house\n",
            HOUSES,
            _house_table(cells),
            "\n### Pictures of other sizes and qualities\n",
            _sweep_table(cells),
            "\n### Time and memory\n",
            TIMES,
            _time_table(cells),
            "",
        ]
    )


MOTIONS = """\
`moved` asks after one of four random rigid motions of the map, which turn it any way up; `yaw_5` and `yaw_17`
after one about the vertical. `as before` is the share of panoramas whose `fine` is that of the map as it was.
"""

VERDICTS = f"""\
`wrong` is beyond {COARSE_M:g} m or {COARSE_DEG:g} degrees; in the map of another room every pose is. FGPL has no verdict. NEES is the squared
error against the covariance for each of the six degrees of freedom, over right answers `FOUND`: 1 for a covariance
that is what it says, less where it is too large.
"""

SYMMETRY = """\
Rooms of boxes in pairs at half a turn from one another: two poses explain each picture equally well. Nothing but
`AMBIGUOUS` with both is a right answer.
"""

HOUSES = """\
ZInD, one house, 12 photographs; the map is the layout of the house: edges of walls, doors and windows, no
furniture. `house` searches all of it, `room` the lines of the room that the photograph was taken in; two photographs
were taken where the layout has no lines.
"""

TIMES = """\
One query from the decoded picture to the answer; `prior` with a first guess that is 25 degrees and 0.4 m off
and trusted within 30 degrees and 0.5 m.
`ratio` is to `fgpl` on the same place in the same run.
"""


def _of(cells: Iterable[Cell], kinds: Sequence[str], *protocols: str) -> list[Cell]:
    return [cell for cell in cells if cell.kind in kinds and cell.protocol in protocols]


def _grouped(cells: Iterable[Cell]) -> dict[str, list[Cell]]:
    groups: dict[str, list[Cell]] = {}
    for cell in cells:
        groups.setdefault(cell.method, []).append(cell)
    return groups


def _trials(cells: Iterable[Cell]) -> list[Trial]:
    return [trial for cell in cells for trial in cell.trials]


def is_within(trial: Trial, max_m: float, max_deg: float) -> bool:
    """Whether the best pose is that near the true one."""
    if trial.translation_m is None or trial.rotation_deg is None:
        return False
    return trial.translation_m <= max_m and trial.rotation_deg <= max_deg


def is_fine(trial: Trial) -> bool:
    """Within 0.1 m and 5 degrees."""
    return is_within(trial, FINE_M, FINE_DEG)


def is_coarse(trial: Trial) -> bool:
    """Within 0.3 m and 15 degrees."""
    return is_within(trial, COARSE_M, COARSE_DEG)


def _share(flags: Sequence[bool]) -> str:
    return f"{100 * np.mean(flags):.1f} %" if flags else MISSING


def _median(values: Sequence[float | None], decimals: int) -> str:
    known = [value for value in values if value is not None]
    return f"{np.median(known):.{decimals}f}" if known else MISSING


def _success_cells(trials: Sequence[Trial]) -> list[str]:
    return [
        f"{len(trials)}",
        _share([is_fine(trial) for trial in trials]),
        _share([is_coarse(trial) for trial in trials]),
        _median([trial.translation_m for trial in trials], 3),
        _median([trial.rotation_deg for trial in trials], 2),
    ]


SUCCESS_HEADINGS = ["panoramas", "fine", "coarse", "median, m", "median, deg"]


def _success_table(cells: Sequence[Cell]) -> str:
    lines = []
    for method, group in _grouped(cells).items():
        for cell in group:
            mark = " *" if cell.is_tuning else ""
            place = [cell.place + mark, f"{cell.line_count}", f"{cell.off_axes_deg:.1f}"]
            lines.append([method, *place, *_success_cells(cell.trials)])
        lines.append([method, "**all**", "", "", *_success_cells(_trials(group))])
        report = [cell for cell in group if not cell.is_tuning]
        lines.append([method, "**all without \\***", "", "", *_success_cells(_trials(report))])
    return table(["method", "place", "lines", "off axes, deg", *SUCCESS_HEADINGS], lines)


def _motion_table(cells: Sequence[Cell]) -> str:
    before = {(cell.method, cell.place): cell.trials for cell in _of(cells, (ROOM,), HERE)}
    lines = []
    for protocol in ("yaw_5", "yaw_17", MOVED):
        for method, group in _grouped(_of(cells, (ROOM,), protocol)).items():
            same = [
                is_fine(trial) == is_fine(old)
                for cell in group
                for trial, old in zip(
                    cell.trials, before.get((method, cell.place), ()), strict=False
                )
            ]
            off = f"{np.median([cell.off_axes_deg for cell in group]):.1f}"
            row = [protocol, method, off if protocol != MOVED else MISSING]
            lines.append([*row, *_success_cells(_trials(group)), _share(same)])
    return table(["motion", "method", "off axes, deg", *SUCCESS_HEADINGS, "as before"], lines)


def _verdict_table(cells: Sequence[Cell]) -> str:
    lines = []
    told = [cell for cell in cells if cell.kind == ROOM and cell.trials[0].status]
    for protocol in (HERE, MOVED, PRIOR, ELSEWHERE):
        chosen = [cell for cell in told if cell.protocol == protocol]
        for method, group in _grouped(chosen).items():
            trials = _trials(group)
            if protocol != ELSEWHERE:
                right = [is_coarse(trial) for trial in trials]
            else:
                right = [False] * len(trials)
            found = [ok for trial, ok in zip(trials, right, strict=True) if trial.status == FOUND]
            nees = [
                trial.nees
                for trial, ok in zip(trials, right, strict=True)
                if ok and trial.status == FOUND and trial.nees is not None
            ]
            counts = [
                f"{sum(trial.status == status for trial in trials)}"
                for status in (FOUND, AMBIGUOUS, NOT_FOUND)
            ]
            wrong = _share([not ok for ok in found])
            mean_nees = number(float(np.mean(nees)) if nees else None, 2)
            lines.append([protocol, method, f"{len(trials)}", *counts, wrong, mean_nees])
    headings = ["protocol", "method", "panoramas", FOUND, AMBIGUOUS, NOT_FOUND]
    return table([*headings, f"wrong of {FOUND}", "mean NEES"], lines)


def _symmetry_table(cells: Sequence[Cell]) -> str:
    lines = []
    for method, group in _grouped(cells).items():
        trials = _trials(group)
        wrong = [trial for trial in trials if not is_coarse(trial)]
        told = bool(trials[0].status)
        lines.append(
            [
                method,
                f"{len(group)}",
                *_success_cells(trials),
                _share([trial.is_listed for trial in trials]),
                _share([trial.status == AMBIGUOUS for trial in trials]) if told else MISSING,
                _share([trial.status == AMBIGUOUS for trial in wrong]) if told else MISSING,
            ]
        )
    headings = ["method", "rooms", *SUCCESS_HEADINGS, "true pose listed", AMBIGUOUS]
    return table([*headings, f"{AMBIGUOUS} of the wrong"], lines)


def _house_table(cells: Sequence[Cell]) -> str:
    lines = []
    names = {HOUSE: "house", HOUSE_ROOM: "room", HOUSE_OUTSIDE: "house, taken outside its lines"}
    for kind, name in names.items():
        for protocol in (HERE, MOVED):
            for method, group in _grouped(_of(cells, (kind,), protocol)).items():
                trials = _trials(group)
                found = [trial for trial in trials if trial.status == FOUND]
                wrong = f"{sum(not is_coarse(trial) for trial in found)} of {len(found)}"
                told = bool(trials[0].status)
                row = [name, protocol, method, *_success_cells(trials)]
                lines.append([*row, wrong if told else MISSING])
    return table(["map", "protocol", "method", *SUCCESS_HEADINGS, f"wrong of {FOUND}"], lines)


def _sweep_table(cells: Sequence[Cell]) -> str:
    names = [cell.protocol for cell in cells if cell.protocol.startswith(("width_", "quality_"))]
    lines = []
    for protocol in dict.fromkeys(names):
        for method, group in _grouped(_of(cells, (ROOM,), protocol)).items():
            trials = _trials(group)
            seconds = _median([trial.seconds for trial in trials], 2)
            lines.append([protocol, method, *_success_cells(trials), seconds])
    return table(["picture", "method", *SUCCESS_HEADINGS, "seconds"], lines)


def _time_table(cells: Sequence[Cell]) -> str:
    anchors = {
        cell.place: _seconds(cell)
        for cell in _of(cells, (ROOM, HOUSE), HERE)
        if cell.method == ANCHOR
    }
    lines = []
    for protocol in (HERE, PRIOR):
        for cell in _of(cells, (ROOM, HOUSE), protocol):
            anchor = anchors.get(cell.place)
            ratio = _seconds(cell) / anchor if anchor else None
            lines.append(
                [
                    cell.place,
                    f"{cell.line_count}",
                    protocol,
                    cell.method,
                    f"{_seconds(cell):.2f}",
                    number(ratio, 2),
                    f"{cell.prepare_seconds:.1f}",
                    number(cell.peak_rss_mib, 0),
                ]
            )
    headings = ["map", "lines", "protocol", "method", "seconds, median", "ratio"]
    return table([*headings, "prepared in, s", "peak of the process, MiB"], lines)


def _seconds(cell: Cell) -> float:
    return float(np.median([trial.seconds for trial in cell.trials]))


def main() -> None:
    """Write the page."""
    text = read_input(DOCUMENT, MAX_PAGE_BYTES).decode()
    write_text(DOCUMENT, page(read_results(RESULTS), text))


if __name__ == "__main__":
    main()
