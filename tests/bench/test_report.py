from dataclasses import replace

import pytest

from roel_bench import report
from roel_bench.acceptance import CRITERIA, Maps
from roel_bench.catalogue import CURVED_ROOMS, LARGE_ROOMS, SMALL_ROOMS
from roel_bench.disturbances import NOISY_POSES
from roel_bench.results import NO_DISTURBANCE, Results, read_results, write_results
from roel_bench.suites import FRONT_END
from roel_bench.tables import all_rows
from roel_bench.variants import CURVE_VARIANTS, DEFAULT_ABLATION, VARIANTS
from tests.bench.samples import row

LARGE, SMALL = LARGE_ROOMS[0], SMALL_ROOMS[0]


def figures(iou=0.3, accuracy_mm=8.0, entity_count=400):
    return {
        "entity_count": entity_count,
        "accuracy_mm": accuracy_mm,
        "accuracy_median_mm": 2.0,
        "completion_mm": 50.0,
        "iou_5": iou / 2,
        "iou_10": iou / 1.5,
        "iou_20": iou,
        "precision_20": 0.8,
        "recall_20": 0.5,
    }


ROWS = (
    row(LARGE, figures=figures(0.4)),
    row(LARGE_ROOMS[1], figures=figures(0.2)),
    row("room_11", is_tuning=True, figures=figures(0.6)),
    row(LARGE, disturbance="noise_events", figures=figures(0.38)),
    row(LARGE, method="paper", figures=figures(0.1, 40.0)),
    row(LARGE, method="EMVS", figures=figures(0.1, 160.0, 100_000)),
    row(LARGE, method=DEFAULT_ABLATION[0].name, figures=figures(0.3)),
    row(LARGE, method=DEFAULT_ABLATION[1].name, figures=figures(0.5)),
    row("events_room01", sensor="346x260", figures={"entity_count": 9, "covered_line_share": 0.9}),
    row(LARGE, task=FRONT_END, figures={"f_score": 0.61, "lines_per_frame": 90.0}),
    row("boxes", sensor="240x180", task=FRONT_END, figures={"lines_per_frame": 28.0}),
)
RESULTS = Results(
    machine={"processor": "P", "core_count": 2, "system": "S", "python": "3"},
    versions={"numpy": "2"},
    rows=ROWS,
)


def found(what, *, with_tuning=False):
    chosen = [criterion for criterion in CRITERIA if criterion.what == what]
    assert len(chosen) == 1
    return chosen[0].measure(Maps(ROWS, with_tuning=with_tuning))


def test_means_leave_out_tuning_rooms_unless_asked():
    assert found("`default`, 640x480: IoU at 20 mm") == pytest.approx(0.3)
    assert found("`default`, 640x480: IoU at 20 mm", with_tuning=True) == pytest.approx(0.4)
    assert found("`default`, 346x260: IoU at 20 mm") is None


def test_ratios_are_of_the_rooms_that_both_have():
    assert found("IoU at 20 mm of `default` over that of `paper`") == pytest.approx(4.0)
    assert found("accuracy of `default` over that of EMVS") == pytest.approx(0.05)
    assert found("lines of `default` over points of EMVS") == pytest.approx(0.004)
    assert found("IoU at 20 mm kept with 15 % noise events") == pytest.approx(0.95)
    assert found("IoU at 20 mm kept with noisy poses") is None


def test_parts_that_pay_are_counted():
    what = "share of the default's parts that raise the mean IoU at 20 mm"
    assert found(what) == 0.5


def test_milliseconds_and_covered_lines():
    assert found("`default`, 640x480: ms a frame") == pytest.approx(100.0)
    assert found("`events_room01`: share of the true lines in the picture that are covered") == 0.9


def line_of(text, beginning):
    lines = [line for line in text.splitlines() if line.startswith(f"| {beginning}")]
    assert lines, beginning
    return lines[0]


def test_page_says_what_passed_and_what_failed():
    page = report.document(RESULTS)
    assert line_of(page, "`default`, 640x480: accuracy").endswith("| pass |")
    assert line_of(page, "`default`, 640x480: IoU at 20 mm").endswith("| **fail** |")
    assert line_of(page, "`default`, 346x260: IoU at 20 mm").endswith("| not run |")
    assert "the same over that of LIMAP with this project's lines | - | - | - |  |" in page


def test_page_tells_what_a_part_is_worth():
    page = report.document(RESULTS)
    # 0.3 instead of 0.4, and 0.5 instead of 0.4.
    assert line_of(page, DEFAULT_ABLATION[0].name).endswith("| 25.0 |")
    assert line_of(page, DEFAULT_ABLATION[1].name).endswith("| -25.0 |")


def test_page_marks_tuning_rooms_and_shows_recordings():
    page = report.document(RESULTS)
    assert "default, room_11 (tuning)" in page
    assert "default, boxes" in page
    assert line_of(page, "events_room01").count("0.900") == 1


def test_tables_have_equal_columns():
    page = report.document(RESULTS)
    for block in page.split("\n\n"):
        lines = block.strip().splitlines()
        if lines and lines[0].startswith("|"):
            assert len({line.count(" | ") for line in lines}) == 1, lines[0]


def test_newest_row_of_a_cell_counts():
    newer = row(LARGE, figures=figures(0.9))
    page = report.document(RESULTS.with_row(newer))
    assert "default, sim_201_640x480_8s | 400 | 8.0 | 2.0 | 50 | 0.450" in page


def test_every_variant_is_told_of():
    """A row that nobody reads is not worth its time."""
    cells = [("map", NO_DISTURBANCE), ("map", NOISY_POSES), (FRONT_END, NO_DISTURBANCE)]
    rows = [
        row(
            LARGE,
            method=name,
            task=task,
            disturbance=disturbance,
            figures=figures(0.01 * k) | {"f_score": 0.01 * k},
        )
        for k, name in enumerate(VARIANTS)
        for task, disturbance in cells
    ]
    with_all = report.document(Results(machine=RESULTS.machine, versions={}, rows=tuple(rows)))
    for missing in VARIANTS:
        kept = tuple(other for other in rows if other.method != missing)
        without = report.document(Results(machine=RESULTS.machine, versions={}, rows=kept))
        assert without != with_all, missing


def test_page_is_written(tmp_path):
    write_results(tmp_path / "a.json", RESULTS)
    report.main(["--results", str(tmp_path / "a.json"), "--out", str(tmp_path / "a.md")])
    assert (tmp_path / "a.md").read_text() == report.document(read_results(tmp_path / "a.json"))


def test_committed_page_is_what_the_committed_rows_give():
    assert report.DOCUMENT.read_text() == report.document(read_results(report.RESULTS))


def test_a_peer_that_failed_is_told_and_counts_in_no_mean():
    failed = row(SMALL, method="LIMAP: best_10", error="PEER_FAILED: exit code -6: abort")
    results = Results(
        machine=RESULTS.machine,
        versions=RESULTS.versions,
        rows=(*ROWS, failed, row(LARGE, method="LIMAP: best_10", figures=figures(0.1))),
    )
    page = report.document(results)
    assert f"LIMAP: best_10 has no map of {SMALL}: PEER_FAILED: exit code -6: abort." in page
    assert "LIMAP: best_10, 640x480, 1 rooms" in page
    assert "LIMAP: best_10, 346x260" not in page


def test_round_edges_are_told_of_where_they_were_mapped():
    assert "## Round edges" not in report.document(RESULTS)
    room, method = CURVED_ROOMS[0], CURVE_VARIANTS[0].name
    curved = {"curved_edge_count": 9000, "curved_recall_20": 0.25}
    rows = (
        row(room, figures=figures(0.3) | curved),
        row(room, method=method, figures=figures(0.33) | curved | {"curved_recall_20": 0.45}),
    )
    results = Results(machine=RESULTS.machine, versions={}, rows=(*ROWS, *rows))
    page = report.document(results)
    section = page.partition("## Round edges")[2]
    assert "| 0.250 |" in line_of(section, f"default, {room}")
    assert "| 0.450 |" in line_of(section, f"{method}, {room}")
    assert "## Round edges" in all_rows(results)


def test_rows_of_other_parameters_are_left_out():
    stale = row(LARGE, config_digest="0" * 12, figures=figures(0.9))
    gone = row(LARGE, figures=figures(0.9))
    gone = replace(gone, method="a method that there is no more")
    results = replace(RESULTS, rows=(stale, gone))
    text = report.document(results)
    assert "2 rows of other parameters than today's are left out" in text
    assert "0.900" not in text
    assert "are left out until" not in report.document(RESULTS)
