from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from scipy.spatial import cKDTree

from roel_bench import registration, registration_report
from roel_bench.registration import ELSEWHERE, PROTOCOLS, keep, read_document, run, write_document
from roel_bench.registration_methods import METHODS, Query, Target, is_available
from roel_bench.registration_places import MAP, Place, part_of, side_by_side, symmetric_rooms
from roel_service.config.stages import RegisterConfig
from roel_service.errors import InputError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.progress import ignore
from roel_service.register.prepare import prepare_cloud
from tests.register.rooms import FURNITURE, ROOM, room_cloud, room_map


@pytest.fixture(scope="module")
def results():
    places = [
        Place(
            name=name,
            line_map=room_map(boxes),
            target=room_cloud(boxes, count=30_000),
            is_tuning=name == "room_11",
        )
        for name, boxes in (("room_11", (ROOM, *FURNITURE)), ("bare", (ROOM, *FURNITURE[:2])))
    ]
    places.append(dataclasses.replace(side_by_side(places), line_map=places[0].line_map))
    places[2] = dataclasses.replace(places[2], target=places[0].target)  # small, for speed
    places.append(
        Place(name="a map on another", line_map=room_map(), target=room_map(seed=5), kind=MAP)
    )
    one_each = [
        dataclasses.replace(p, count=1)
        for p in PROTOCOLS
        if p.method in ("auto", "global") and p.kinds != ("symmetric",)
    ]
    return run(places, one_each, ignore)


def test_every_protocol_runs_on_every_place(results):
    kinds = {(trial["place"], trial["protocol"]) for trial in results["trials"]}
    own = {p.name for p in PROTOCOLS if p.kinds == ("room",)}
    large = {p.name for p in PROTOCOLS if p.kinds == ("large",)}
    maps = {p.name for p in PROTOCOLS if p.kinds == ("map",)}
    assert kinds == {(n, p) for n in ("room_11", "bare") for p in own} | {
        ("2 rooms side by side", p) for p in large
    } | {("a map on another", p) for p in maps}
    for trial in results["trials"]:
        if trial["protocol"] not in ELSEWHERE:
            assert not registration_report.is_wrong(trial), trial


def test_trials_are_read_back_as_written(tmp_path, results):
    write_document(tmp_path / "r.json", results)
    assert read_document(tmp_path / "r.json") == results
    (tmp_path / "r.json").write_text('{"format": "another"}')
    with pytest.raises(InputError, match="expected roel registration benchmark 2"):
        read_document(tmp_path / "r.json")


def test_what_a_file_holds_is_not_run_again(tmp_path, results):
    path = tmp_path / "r.json"
    trial = registration.Trial(**results["trials"][0])
    keep([dataclasses.replace(trial, seconds=99.0)], path)
    place = Place(name=trial.place, line_map=room_map(), target=room_cloud(count=200))
    protocol = next(p for p in PROTOCOLS if (p.name, p.method) == (trial.protocol, trial.method))
    again = run([place], [dataclasses.replace(protocol, count=1)], ignore, path=path)
    assert [known["seconds"] for known in again["trials"]] == [99.0]
    keep([dataclasses.replace(trial, seconds=1.0)], path)
    assert [known["seconds"] for known in read_document(path)["trials"]] == [1.0]


def test_the_page_counts_what_was_measured(results):
    page = registration_report.document(results)
    assert "| paper | auto | room_11 * | 60 | " in page
    assert "| elsewhere | global |" in page
    assert "| heading | global | 2 rooms side by side * |" in page


@pytest.fixture(scope="module")
def target():
    config = dataclasses.replace(RegisterConfig(), voxel_m=0.05)
    return Target(cloud=prepare_cloud(room_cloud(count=20_000), config))


# Features find what they find: of those searches this only shows that they run.
@pytest.mark.parametrize(
    ("method", "bound_deg", "bound_mm"),
    [(name, *((180.0, 1e4) if "fpfh" in name else (1.0, 30.0))) for name in METHODS],
)
def test_every_method_comes_home_from_a_close_start(target, method, bound_deg, bound_mm):
    if not is_available(method):
        pytest.skip(f"{method} is not installed")
    T_init = SE3(rotation=rotation_from_vector(np.array([0.0, 0.01, 0.01])), translation=[0.01] * 3)
    config = dataclasses.replace(RegisterConfig(), voxel_m=0.05, sample_spacing_m=0.05)
    query = Query(line_map=room_map(), target=target, T_init=T_init, config=config)
    found = METHODS[method](query).T_target_source
    degrees, millimetres = registration.errors(found, SE3.identity())
    assert degrees <= bound_deg
    assert millimetres < bound_mm


def test_rooms_side_by_side_keep_their_maps_on_their_clouds():
    places = [
        Place(name=f"{i}", line_map=room_map(), target=room_cloud(count=5_000)) for i in range(3)
    ]
    large = side_by_side(places)
    assert len(large.line_map) == 3 * len(room_map())
    assert len(large.target) == 15_000
    distance_m, _ = cKDTree(large.target.points).query(large.line_map.segments.reshape(-1, 3))
    assert np.median(distance_m) < 0.1  # 5,000 points leave gaps
    assert (np.ptp(large.target.points, axis=0)[:2] > 1.9 * np.array([4.0, 3.2])).all()


def test_a_part_of_a_cloud_ends_at_a_plane():
    cloud = room_cloud(count=5_000)
    part = part_of(cloud, 0.7)
    assert len(part) == pytest.approx(3_500, abs=1)
    assert part.points[:, 0].max() < np.quantile(cloud.points[:, 0], 0.701)


def test_symmetric_rooms_are_left_alike_by_half_a_turn():
    (place,) = symmetric_rooms(1)
    turned = place.symmetry @ place.target.points[:2000].astype(np.float64)
    distance_m, _ = cKDTree(place.target.points).query(turned)
    assert np.quantile(distance_m, 0.95) < 0.05


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
