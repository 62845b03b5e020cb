from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from roel_bench import registration, registration_report
from roel_bench.registration import PROTOCOLS, Place, read_document, run, write_document
from roel_service.errors import InputError
from roel_service.geometry.se3 import rotation_angle
from roel_service.progress import ignore
from tests.register.rooms import FURNITURE, ROOM, room_cloud, room_map


@pytest.fixture(scope="module")
def results():
    places = [
        Place(
            name=name,
            line_map=room_map(boxes),
            cloud=room_cloud(boxes, count=30_000),
            is_tuning=name == "room_11",
        )
        for name, boxes in (("room_11", (ROOM, *FURNITURE)), ("bare", (ROOM, *FURNITURE[:2])))
    ]
    one_each = [dataclasses.replace(p, count=1) for p in PROTOCOLS if p.method != "point"]
    return run(places, one_each, ignore)


def test_every_protocol_runs_on_every_place(results):
    kinds = {(trial["place"], trial["protocol"]) for trial in results["trials"]}
    assert kinds == {(n, p.name) for n in ("room_11", "bare") for p in PROTOCOLS}
    for trial in results["trials"]:
        if trial["protocol"] != "elsewhere":
            assert not registration_report.is_wrong(trial), trial


def test_trials_are_read_back_as_written(tmp_path, results):
    write_document(tmp_path / "r.json", results)
    assert read_document(tmp_path / "r.json") == results
    (tmp_path / "r.json").write_text('{"format": "another"}')
    with pytest.raises(InputError, match="expected roel registration benchmark 1"):
        read_document(tmp_path / "r.json")


def test_the_page_counts_what_was_measured(results):
    page = registration_report.document(results)
    assert "| paper | auto | room_11 * | 60 | 1 |" in page
    assert "| elsewhere | global |" in page


def test_the_committed_page_is_that_of_the_committed_trials():
    page = registration_report.document(read_document(registration_report.RESULTS))
    assert registration_report.DOCUMENT.read_text(encoding="utf-8") == page


def test_starts_are_as_far_off_as_said():
    rng = np.random.default_rng(0)
    wide = [registration.wide_start(rng) for _ in range(300)]
    turns = np.array([rotation_angle(T.rotation) for T in wide])
    assert np.radians(29) < turns.max() <= np.radians(30)
    assert max(np.linalg.norm(T.translation) for T in wide) <= 0.3
    paper = [registration.paper_start(rng) for _ in range(300)]
    yaw = [np.arctan2(T.rotation[1, 0], T.rotation[0, 0]) for T in paper]
    assert np.degrees(np.std(yaw)) == pytest.approx(10.0, abs=1.5)
    assert np.std([T.translation for T in paper]) == pytest.approx(0.02, abs=0.002)
