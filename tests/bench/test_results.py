import json
import math
from dataclasses import replace

import pytest

from roel_bench.results import (
    Results,
    config_digest,
    front_end_digest,
    read_results,
    this_machine,
    write_results,
)
from roel_service.config.load import with_tables
from roel_service.config.presets import preset
from roel_service.errors import InputError
from tests.bench.samples import row

EMPTY = Results(machine={"core_count": 2}, versions={"numpy": "2"})


def test_results_read_back_as_written(tmp_path):
    results = EMPTY.with_row(row(figures={"iou_20": 0.5, "accuracy_mm": None}))
    write_results(tmp_path / "a.json", results)
    assert read_results(tmp_path / "a.json") == results


def test_figures_are_written_with_six_digits_and_without_nan(tmp_path):
    results = EMPTY.with_row(row(figures={"iou_20": 1 / 3, "bias": math.nan, "count": 1234567}))
    write_results(tmp_path / "a.json", results)
    figures = json.loads((tmp_path / "a.json").read_text())["rows"][0]["figures"]
    assert figures == {"iou_20": 0.333333, "bias": None, "count": 1234567}


def test_a_row_takes_the_place_of_the_older_one_of_its_key():
    first = row(figures={"iou_20": 0.1})
    other = row(method="paper")
    again = replace(first, figures={"iou_20": 0.2}, config_digest="1" * 12)
    results = EMPTY.with_row(first).with_row(other).with_row(again)
    assert results.rows == (other, again)


def test_digest_follows_parameters_but_not_the_runtime():
    default = preset("default")
    other = with_tables(default, {"refine": {"event_weight": 0.5}}, subject="sample")
    workers = with_tables(default, {"runtime": {"worker_count": 3}}, subject="sample")
    assert config_digest(default) == config_digest(workers) != config_digest(other)


@pytest.mark.parametrize(
    "tables",
    [
        {"localize": {"grid_step_m": 0.5}},
        {"register": {"voxel_m": 0.5}},
        {"track": {"interval_us": 20_000}},
        {"curves": {"piece_length_px": 12.0}},
        {"refine": {"pose_drift_m": 0.01}},
    ],
)
def test_digest_does_not_follow_what_no_line_depends_on(tables):
    default = preset("default")
    assert config_digest(with_tables(default, tables, subject="sample")) == config_digest(default)


def test_digest_does_not_follow_corners_that_are_left_alone():
    paper = preset("paper")
    other = with_tables(paper, {"refine": {"corner_depth_m": 0.05}}, subject="sample")
    assert config_digest(other) == config_digest(paper)


def test_digest_of_single_frames_follows_their_stages_alone():
    default = preset("default")
    trimmed = with_tables(default, {"trim": {"max_gap_m": 0.1}}, subject="sample")
    detected = with_tables(default, {"detect": {"blur_px": 2.0}}, subject="sample")
    assert front_end_digest(trimmed) == front_end_digest(default) != front_end_digest(detected)


@pytest.mark.parametrize(
    ("on", "parameter"),
    [
        ({"curves": {"method": "polyline"}}, {"curves": {"piece_length_px": 12.0}}),
        ({"refine": {"free_poses": True}}, {"refine": {"pose_drift_m": 0.01}}),
    ],
)
def test_digest_follows_the_parameters_of_what_is_on(on, parameter):
    config = with_tables(preset("default"), on, subject="sample")
    other = with_tables(config, parameter, subject="sample")
    assert config_digest(other) != config_digest(config) != config_digest(preset("default"))


def test_milliseconds_a_frame_are_of_all_stages():
    assert row().ms_per_frame == 100.0
    assert row(frame_count=0).ms_per_frame is None


def test_processor_time_is_told_where_it_was_measured():
    assert row(processor_s=1.5).processor_ms_per_frame == 75.0
    assert row().processor_ms_per_frame is None
    assert row(processor_s=1.5, frame_count=0).processor_ms_per_frame is None


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"format": "x"}'])
def test_other_files_are_no_results(tmp_path, text):
    (tmp_path / "a.json").write_text(text)
    with pytest.raises(InputError, match=r"a\.json"):
        read_results(tmp_path / "a.json")


def test_machine_is_described():
    machine = this_machine()
    assert machine.machine["core_count"] >= 1
    assert machine.versions["roel_service"]
    assert machine.rows == ()
