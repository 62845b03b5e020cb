from dataclasses import replace

import numpy as np
import pytest

from roel_bench import runner
from roel_bench.catalogue import WARM_UP_ROOM, Places
from roel_bench.methods import Mapped, Method
from roel_bench.results import FILE_NAME, Results, read_results, write_results
from roel_bench.runner import Runner
from roel_bench.suites import FRONT_END, MAP, Cell, current_digest
from roel_bench.tables import all_rows
from roel_service.errors import InputError, NoAnswerError
from roel_service.progress import Progress
from roel_service.scene.lines import LineMap
from tests.bench.samples import row

CELLS = [
    Cell(task=MAP, scene=WARM_UP_ROOM, method="default"),
    Cell(task=MAP, scene=WARM_UP_ROOM, method="default", disturbance="noise_events"),
    Cell(task=FRONT_END, scene=WARM_UP_ROOM, method="default"),
]


@pytest.fixture(scope="module")
def places(rooms):
    return Places(data=None, rooms=rooms)


@pytest.fixture(scope="module")
def folder(places, tmp_path_factory):
    """A run of all cells."""
    folder = tmp_path_factory.mktemp("run")
    Runner(places=places, folder=folder).run(CELLS)
    return folder


def test_every_cell_has_its_row(folder):
    rows = read_results(folder / FILE_NAME).rows
    assert [(row.task, row.disturbance, row.method) for row in rows] == [
        (cell.task, cell.disturbance, cell.method) for cell in CELLS
    ]
    clean, noisy, frames = rows
    assert noisy.event_count > clean.event_count
    assert 0 <= clean.figures["iou_20"] < 1
    assert clean.frame_count >= 24
    assert clean.ms_per_frame > 0
    assert clean.processor_s > 0
    assert clean.seconds.keys() > {"detect", "plane_fit", "trim"}
    assert 0 < frames.figures["f_score"] < 1
    assert [row.config_digest for row in rows] == [
        current_digest(cell.task, cell.method) for cell in CELLS
    ]


def test_pictures_are_of_what_is_not_disturbed(folder):
    pictures = sorted(path.name for path in (folder / "pictures").iterdir())
    assert pictures == [
        f"front_end_{WARM_UP_ROOM}_default.png",
        f"map_{WARM_UP_ROOM}_default.png",
    ]
    assert all(
        (folder / "pictures" / name).read_bytes().startswith(b"\x89PNG") for name in pictures
    )


def test_rows_that_are_there_are_not_run_again(folder, places):
    before = (folder / FILE_NAME).stat().st_mtime_ns
    told: list[Progress] = []
    results = Runner(places=places, folder=folder, progress=told.append).run(CELLS)
    assert len(results.rows) == len(CELLS)
    assert told == []
    assert (folder / FILE_NAME).stat().st_mtime_ns == before


def test_a_row_of_other_parameters_is_run_again_and_replaced(folder, places, tmp_path):
    done = read_results(folder / FILE_NAME).rows[0]
    stale = replace(done, config_digest="0" * 12, figures={"iou_20": 0.123})
    write_results(tmp_path / FILE_NAME, replace(read_results(folder / FILE_NAME), rows=(stale,)))
    Runner(places=places, folder=tmp_path).run(CELLS[:1])
    (row,) = read_results(tmp_path / FILE_NAME).rows
    assert (row.config_digest, row.figures) == (done.config_digest, done.figures)


def test_an_interrupted_run_goes_on(folder, places, tmp_path):
    done = read_results(folder / FILE_NAME)
    write_results(tmp_path / FILE_NAME, replace(done, rows=done.rows[:2]))
    told: list[Progress] = []
    results = Runner(places=places, folder=tmp_path, progress=told.append).run(CELLS)
    assert results.rows[:2] == done.rows[:2]
    assert len(results.rows) == 3
    assert {progress.stage for progress in told} == {f"{WARM_UP_ROOM} default"}
    fractions = [progress.fraction for progress in told]
    assert fractions == sorted(fractions)
    assert min(fractions) >= 2 / 3


def test_results_of_another_machine_are_not_mixed_with(places, tmp_path):
    other = Results(machine={"core_count": 1000}, versions={}).with_row(row())
    write_results(tmp_path / FILE_NAME, other)
    with pytest.raises(InputError, match="this machine"):
        Runner(places=places, folder=tmp_path).run(CELLS)
    assert read_results(tmp_path / FILE_NAME) == other


def test_a_folder_that_cannot_be_written(places, tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(InputError, match="a folder to write to"):
        Runner(places=places, folder=tmp_path / "file").run(CELLS)


@pytest.mark.parametrize("wrong", [{"scene": "nope"}, {"method": "nope"}])
def test_unknown_names_are_told_before_anything_runs(places, tmp_path, wrong):
    told: list[Progress] = []
    cells = [CELLS[0], replace(CELLS[0], **wrong)]
    with pytest.raises(InputError, match="'nope'"):
        Runner(places=places, folder=tmp_path / "new", progress=told.append).run(cells)
    assert told == []
    assert not (tmp_path / "new").exists()


def test_windows_longer_than_the_warm_up_are_no_obstacle(places, tmp_path):
    cell = Cell(task=FRONT_END, scene=WARM_UP_ROOM, method="paper: windows x 10, no planes")
    with pytest.raises(NoAnswerError, match="at least one frame"):
        Runner(places=places, folder=tmp_path).run([cell])
    longer = replace(cell, scene="sim_1_32x24_0.7s")
    results = Runner(places=places, folder=tmp_path).run([longer])
    assert results.rows[0].frame_count >= 1


def fails(reason):
    def run(scene, progress):
        raise NoAnswerError("limap", "segments", "exit code -6: abort", reason=reason)

    return Method(name="LIMAP: best_10", digest="0" * 12, run=run)


@pytest.mark.parametrize("reason", ["PEER_FAILED", "PEER_TIMEOUT"])
def test_a_peer_that_fails_is_an_error_and_no_empty_map(places, tmp_path, monkeypatch, reason):
    cell = Cell(task=MAP, scene=WARM_UP_ROOM, method="LIMAP: best_10")
    monkeypatch.setattr(runner, "find_method", lambda name: fails(reason))
    results = Runner(places=places, folder=tmp_path).run([cell])
    (failed,) = results.rows
    assert failed.error == f"{reason}: exit code -6: abort"
    assert failed.figures == {}
    assert read_results(tmp_path / FILE_NAME) == results
    assert f"LIMAP: best_10 (**{failed.error}**)" in all_rows(results)


def test_a_peer_that_failed_is_run_again(places, tmp_path, monkeypatch):
    cell = Cell(task=MAP, scene=WARM_UP_ROOM, method="LIMAP: best_10")
    monkeypatch.setattr(runner, "find_method", lambda name: fails("PEER_TIMEOUT"))
    Runner(places=places, folder=tmp_path).run([cell])
    empty = Mapped(entities=LineMap.from_segments(np.empty((0, 2, 3))), seconds={"map": 1.0})
    found = Method(name=cell.method, digest="0" * 12, run=lambda scene, progress: empty)
    monkeypatch.setattr(runner, "find_method", lambda name: found)
    (row,) = Runner(places=places, folder=tmp_path).run([cell]).rows
    assert row.error == ""
    assert row.figures["iou_20"] == 0.0
