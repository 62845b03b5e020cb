import numpy as np
import pytest

from roel_service.config.stages import TrackConfig
from roel_service.errors import EventsError, NoAnswerError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.results import PoseStatus
from roel_service.tracking.tracker import MAX_SILENCE_US, PoseTracker

from .synthetic import CAMERA, recording, walls

CONFIG = TrackConfig()


def off(seed, share=1.0):
    """A tangent as far off as a first pose may be."""
    rng = np.random.default_rng(seed)
    turn, shift = (vector / np.linalg.norm(vector) for vector in rng.normal(size=(2, 3)))
    return share * np.concatenate([np.deg2rad(CONFIG.reach_deg) * turn, CONFIG.reach_m * shift])


def tracked(room, tracker, chunks=None):
    return [pose for chunk in chunks or room.chunks() for pose in tracker.push(chunk)]


def errors(room, poses):
    """(N, 2) degrees and metres of those that have a pose."""
    rows = []
    for pose in poses:
        if pose.T_world_camera is not None:
            step = room.pose(pose.t_us).inverse() @ pose.T_world_camera
            turn_rad = rotation_angle(step.rotation[None])[0]
            rows.append([np.rad2deg(turn_rad), np.linalg.norm(step.translation)])
    return np.array(rows)


@pytest.fixture(scope="module")
def room():
    return recording(seconds=1.2)


@pytest.fixture(scope="module")
def followed(room):
    """All poses, from a first one that is 20 cm and 10 degrees off."""
    first = room.pose(25_000).retract(off(1))
    return tracked(room, PoseTracker(room.line_map, CAMERA, CONFIG, first))


def test_poses_come_at_every_interval(followed):
    times = np.array([pose.t_us for pose in followed])
    assert (np.diff(times) == CONFIG.interval_us).all()
    assert len(times) == 47


def test_the_camera_is_looked_for_then_followed(room, followed):
    statuses = [pose.status for pose in followed]
    # As many intervals as slices, at the most, and as what was found needs to catch up.
    found = min(k for k, status in enumerate(statuses) if status is not PoseStatus.LOST)
    assert statuses[:found] == [PoseStatus.LOST] * found
    assert PoseStatus.LOST not in statuses[found:]
    assert statuses[-10:] == [PoseStatus.TRACKING] * 10
    assert 1 < found < 14
    turn_deg, shift_m = errors(room, followed).max(axis=0)
    assert turn_deg < 0.3
    assert shift_m < 0.01


def test_in_a_recording_a_search_is_over_in_its_interval(room):
    first = room.pose(25_000).retract(off(1))
    tracker = PoseTracker(room.line_map, CAMERA, CONFIG, first, is_live=False)
    poses = tracker.push(room.events.part(0, int(np.searchsorted(room.events.t_us, 200_000))))
    assert poses[1].status is PoseStatus.UNCERTAIN
    assert poses[-1].status is PoseStatus.TRACKING
    turn_deg, shift_m = errors(room, poses[1:]).max(axis=0)
    assert turn_deg < 0.3
    assert shift_m < 0.01


def test_errors_go_with_the_covariances(room, followed):
    distances = []
    for pose in followed:
        if pose.T_world_camera is None:
            continue
        step = pose.T_world_camera.local(room.pose(pose.t_us))
        distances.append(step @ np.linalg.solve(pose.covariance, step))
    # Six numbers each; twice their expectation is allowed for.
    assert np.mean(distances) < 12.0


# The last ones are so many that they are joined while no pose is due.
@pytest.mark.parametrize("chunk_us", [7_919, 1_000_000, 313])
def test_chunks_of_any_size_give_the_same_poses(room, followed, chunk_us):
    first = room.pose(25_000).retract(off(1))
    tracker = PoseTracker(room.line_map, CAMERA, CONFIG, first)
    again = tracked(room, tracker, room.chunks(chunk_us))
    assert [pose.status for pose in again] == [pose.status for pose in followed]
    for one, other in zip(again, followed, strict=True):
        if one.T_world_camera is not None:
            np.testing.assert_array_equal(
                one.T_world_camera.translation, other.T_world_camera.translation
            )


def test_a_camera_at_rest_keeps_its_pose(underway):
    tracker, _, rest = underway
    first_us = int(rest.t_us[0])
    # Some noise, and no motion.
    rng = np.random.default_rng(2)
    t_us = np.sort(rng.integers(first_us + 20_000, first_us + 500_000, 400))
    events = EventStream(
        t_us=np.concatenate([rest.t_us[rest.t_us < first_us + 20_000], t_us]),
        x=np.concatenate([rest.x[rest.t_us < first_us + 20_000], rng.integers(0, 240, 400)]),
        y=np.concatenate([rest.y[rest.t_us < first_us + 20_000], rng.integers(0, 180, 400)]),
        polarity=np.ones(400 + int((rest.t_us < first_us + 20_000).sum()), np.int8),
        width=CAMERA.width,
        height=CAMERA.height,
    )
    after = tracker.push(events)
    assert PoseStatus.LOST not in {each.status for each in after}
    stays = after[-1].T_world_camera.local(after[-8].T_world_camera)
    assert np.abs(stays).max() < 0.005


def test_in_another_place_there_is_no_pose(room):
    elsewhere = LineMap.from_segments(walls(7))
    tracker = PoseTracker(elsewhere, CAMERA, CONFIG, room.pose(25_000))
    poses = tracked(room, tracker, room.chunks()[:4])
    assert {pose.status for pose in poses} == {PoseStatus.LOST}
    assert all(pose.T_world_camera is None and pose.covariance is None for pose in poses)


def moved(events, *, later_us=0, is_turned=False):
    """Events at another time, or as if the camera were upside down."""
    return EventStream(
        t_us=events.t_us + later_us,
        x=CAMERA.width - 1 - events.x if is_turned else events.x,
        y=CAMERA.height - 1 - events.y if is_turned else events.y,
        polarity=events.polarity,
        width=CAMERA.width,
        height=CAMERA.height,
    )


@pytest.fixture
def underway(room):
    """A tracker that follows a camera, its last pose, and events in which two searches fit."""
    tracker = PoseTracker(room.line_map, CAMERA, CONFIG, room.pose(25_000))
    cut = int(np.searchsorted(room.events.t_us, 480_000))
    pose = tracker.push(room.events.part(0, cut))[-1]
    assert pose.status is PoseStatus.TRACKING
    return tracker, pose, room.events.part(cut, len(room.events))


def test_a_camera_that_jumps_is_lost_at_once(underway):
    tracker, _, rest = underway
    after = tracker.push(moved(rest, is_turned=True))
    # The first interval holds events of before.
    assert PoseStatus.TRACKING not in {pose.status for pose in after[1:]}
    assert after[-1].status is PoseStatus.LOST


def test_a_hint_leads_to_where_the_camera_is_now(room, underway):
    tracker, _, rest = underway
    now = room.pose(int(rest.t_us[0]))
    upside_down = rotation_from_vector(np.array([0.0, 0.0, np.pi]))
    tracker.guess(SE3(rotation=now.rotation @ upside_down, translation=now.translation))
    after = tracker.push(moved(rest, is_turned=True))
    assert after[-1].T_world_camera.translation == pytest.approx(
        room.pose(after[-1].t_us).translation, abs=0.01
    )


def test_a_silence_makes_the_tracker_look_again(underway):
    tracker, pose, rest = underway
    after = tracker.push(moved(rest, later_us=2 * MAX_SILENCE_US))
    assert after[0].status is PoseStatus.LOST
    assert after[0].t_us > pose.t_us + MAX_SILENCE_US
    # Where it was, not where its motion would have led.
    assert after[-1].status is not PoseStatus.LOST


def test_events_that_go_back_in_time_are_refused(room):
    tracker = PoseTracker(room.line_map, CAMERA, CONFIG, room.pose(25_000))
    tracker.push(room.events.part(0, 20_000))
    with pytest.raises(EventsError) as caught:
        tracker.push(room.events.part(0, 10))
    assert caught.value.reason == "EVENT_TIME_NOT_MONOTONE"


def test_events_of_another_sensor_are_refused(room):
    tracker = PoseTracker(room.line_map, CAMERA, CONFIG, room.pose(25_000))
    one = np.array([5])
    events = EventStream(t_us=one, x=one, y=one, polarity=np.ones(1), width=100, height=100)
    with pytest.raises(EventsError, match="240x180"):
        tracker.push(events)


def test_a_map_of_a_few_lines_holds_no_pose(room):
    few = LineMap.from_segments(room.line_map.segments[:5])
    with pytest.raises(NoAnswerError) as caught:
        PoseTracker(few, CAMERA, CONFIG, room.pose(0))
    assert caught.value.reason == "TOO_FEW_LINES"
