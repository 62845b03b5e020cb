import numpy as np
import pytest

from roel_bench import poses, poses_report
from roel_bench.poses import PoseResults, read_results, write_results
from roel_bench.poses_cube import IN_A_MAP, METHODS, CubeRow, default_config
from roel_bench.poses_rooms import PoseErrors, RoomRow, normalised_errors
from roel_service.config.presets import preset
from roel_service.errors import InputError
from roel_service.scene.results import PoseReport, PoseResult
from roel_service.scene.trajectory import Trajectory

from ..mapping.synthetic import trajectory

REPORT = PoseReport(
    line_count=9,
    observation_count=90,
    iteration_count=5,
    converged=True,
    cost_initial=1.0,
    cost_final=0.1,
    time_offset_us=0.0,
    time_offset_sigma_us=500.0,
    problems=(),
    seconds={},
)


def cube_row(method, ate):
    return CubeRow(
        method=method,
        seed=0,
        frame_count=100,
        line_count=30,
        ate_hundredths=ate,
        sim3_hundredths=ate / 2,
        scale=1.01,
        rotation_deg=0.5,
        seconds=1.0,
    )


def some_results():
    errors = PoseErrors(ate_mm=8.0, rotation_deg=0.4)
    better = PoseErrors(ate_mm=4.0, rotation_deg=0.1)
    room = RoomRow(
        room="room_12",
        sensor="346x260",
        is_tuning=True,
        given=errors,
        smooth=errors,
        refined=better,
        exact=better,
        nees=1.2,
        time_offset_ms=0.1,
        problems=("FAR_OFF",),
        iou_true=0.4,
        iou_refined=0.3,
        iou_aligned=0.36,
        seconds=12.0,
    )
    cube = [cube_row("none", 33.0), cube_row("default", 1.5)]
    return PoseResults(machine={}, versions={}, cube=cube, rooms=[room])


def test_rows_come_back_as_they_were_written(tmp_path):
    write_results(tmp_path / "poses.json", some_results())
    found = read_results(tmp_path / "poses.json")
    assert (found.cube, found.rooms) == (some_results().cube, some_results().rooms)


@pytest.mark.parametrize("text", ["{}", '{"format": "other"}', "rows"])
def test_another_file_is_refused(text, tmp_path):
    (tmp_path / "poses.json").write_text(text)
    with pytest.raises(InputError, match="expected"):
        read_results(tmp_path / "poses.json")


def test_rows_that_are_there_are_not_run_again(tmp_path):
    path = tmp_path / "poses.json"
    write_results(path, some_results())
    nowhere = poses.Places(data=None, rooms=tmp_path / "rooms")
    found = poses.run(path, ["room_12"], 1, nowhere, lambda step: None)
    assert found.rooms == some_results().rooms
    assert not (tmp_path / "rooms").exists()


def test_the_page_has_the_rows_in_the_papers_order():
    results = some_results()
    machine = {"processor": "p", "core_count": 2, "system": "s", "python": "3"}
    results = PoseResults(machine=machine, versions={}, cube=results.cube, rooms=results.rooms)
    page = poses_report.document(results)
    assert page.index("| none | 1 | 100 | 30 | 33.00 |") < page.index("| default | 1 |")
    assert "| room_12*, 346x260 | 8.00, 0.400 |" in page
    assert "0.50, 0.25" in page
    assert list(METHODS)[:4] == [
        "none",
        "reprojection",
        "line Grassmann",
        "line + event Grassmann",
    ]


def test_the_default_meets_the_cube_in_its_own_unit():
    cube, room = default_config().trim, preset("default").trim
    for name in ("max_gap_m", "min_length_m", "max_error_m"):
        assert getattr(cube, name) == pytest.approx(10.0 * getattr(room, name))
    # Smoothing leaves about a third of the .33 units of each pose.
    assert default_config().refine.pose_drift_m == pytest.approx(0.33 / 3, rel=0.2)


def test_errors_drawn_from_the_covariance_are_honest():
    given = trajectory()
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-3
    covariance = np.broadcast_to(root @ root.T + 1e-9 * np.eye(6), (len(given), 6, 6))
    errors = rng.multivariate_normal(np.zeros(6), covariance[0], len(given))
    found = Trajectory(t_us=given.t_us, T_world_camera=given.T_world_camera.retract(errors))
    result = PoseResult(trajectory=found, covariance=covariance, report=REPORT)
    assert normalised_errors(result, given, given).mean() == pytest.approx(1.0, abs=0.2)


def test_the_page_is_that_of_the_committed_rows():
    page = poses_report.document(read_results(poses_report.RESULTS))
    assert poses_report.DOCUMENT.read_text(encoding="utf-8") == page


class TestTheCommittedRows:
    """What refinement is held to; a row that falls short is no row to commit unnoticed."""

    def test_the_cube_has_the_papers_order_and_a_fraction_of_its_error(self):
        rows = read_results(poses_report.RESULTS).cube
        of_method = {
            method: [row.ate_hundredths for row in rows if row.method == method]
            for method in (*METHODS, IN_A_MAP)
        }
        assert {len(errors) for errors in of_method.values()} == {5}
        means = [float(np.mean(of_method[method])) for method in list(METHODS)[:4]]
        assert means == sorted(means, reverse=True)
        assert max(of_method[IN_A_MAP]) < 2.0

    @pytest.mark.parametrize(("width", "share"), [(640, 0.45), (346, 0.7)])
    def test_poses_of_rooms_get_better_everywhere(self, width, share):
        rooms = read_results(poses_report.RESULTS).rooms
        rooms = [room for room in rooms if room.sensor.startswith(f"{width}x")]
        assert len(rooms) == 3
        pairs = [(room.refined, room.given) for room in rooms]
        shifts = [refined.ate_mm / given.ate_mm for refined, given in pairs]
        turns = [refined.rotation_deg / given.rotation_deg for refined, given in pairs]
        assert np.mean(shifts) <= share
        assert np.mean(turns) <= 0.4
        assert max(*shifts, *turns) < 1.0

    def test_exact_poses_stay_and_covariances_and_maps_are_good(self):
        rooms = read_results(poses_report.RESULTS).rooms
        assert max(room.exact.ate_mm for room in rooms) < 0.5
        assert 0.5 <= np.mean([room.nees for room in rooms]) <= 2.0
        assert np.mean([room.iou_refined / room.iou_true for room in rooms]) >= 0.85
