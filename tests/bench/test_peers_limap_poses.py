import numpy as np
import pytest

from roel_bench.peers import limap_poses
from roel_bench.peers.limap_poses import adjusted_poses, read_poses, seen_segments, write_problem
from roel_service.errors import NoAnswerError, NotFoundError
from roel_service.geometry import plucker
from roel_service.geometry.se3 import SE3
from roel_service.mapping.evidence import Evidence
from roel_service.mapping.frames import Frames
from roel_service.mapping.front_end import Detected
from roel_service.mapping.refine import Refined
from roel_service.mapping.views import views_of
from roel_service.scene.lines import InfiniteLines, LineObservations, LineTracks

K = np.array([[200.0, 0.0, 100.0], [0.0, 200.0, 80.0], [0.0, 0.0, 1.0]])
# An upright and a level line, seen by two cameras half a metre apart.
SEGMENTS = np.array([[[0.2, -0.5, 3.0], [0.2, 0.5, 3.0]], [[-0.4, 0.3, 4.0], [0.9, 0.3, 4.0]]])
CENTRES = np.array([[0.0, 0.0, 0.0], [0.5, 0.0, 0.0]])


@pytest.fixture
def seen():
    poses = SE3(rotation=np.stack([np.eye(3)] * 2), translation=CENTRES)
    frames = Frames(t_us=np.array([0, 10]), T_world_camera=poses, K=K, width=200, height=160)
    rays = SEGMENTS[None] - CENTRES[:, None, None]
    segments_px = ((rays / rays[..., 2:]) @ K.T)[..., :2].reshape(-1, 2, 2)
    observations = LineObservations(
        frame=np.array([0, 0, 1, 1]),
        segments_px=segments_px,
        polarity=np.zeros(4, np.int8),
        normal_speed_px_per_ms=np.zeros(4),
        event_offsets=np.zeros(5, np.int64),
        event_xy_px=np.empty((0, 2), np.float32),
        event_dt_us=np.empty(0, np.int32),
    )
    views = views_of(observations, frames)
    forms = np.zeros((4, 6, 6))
    evidence = Evidence(
        views=views, event_forms=forms, segment_forms=forms, event_counts=np.zeros(4, np.int64)
    )
    detected = Detected(
        frames=frames, observations=observations, evidence=evidence, pieces=observations, images={}
    )
    direction, moment = plucker.plucker_from_endpoints(SEGMENTS)
    refined = Refined(
        lines=InfiniteLines(direction=direction, moment=moment),
        tracks=LineTracks(offsets=np.array([0, 2, 4]), observation=np.array([0, 2, 1, 3])),
        origin=np.zeros((2, 3)),
        rms_px=np.zeros(2),
        information=np.zeros((2, 4, 4)),
        diverged=np.zeros(2, np.bool_),
    )
    return refined, detected


def test_lines_reach_as_far_as_they_were_seen(seen):
    found = np.sort(seen_segments(*seen), axis=1)
    np.testing.assert_allclose(found, np.sort(SEGMENTS, axis=1), atol=1e-9)


def test_observations_are_told_by_frame_and_by_their_place_in_it(seen, tmp_path):
    path = tmp_path / "problem.npz"
    write_problem(path, *seen)
    with np.load(path) as file:
        np.testing.assert_array_equal(file["observations"], [[0, 0], [1, 0], [0, 1], [1, 1]])
        np.testing.assert_array_equal(file["line_offsets"], [0, 2, 4])
        np.testing.assert_array_equal(file["track_offsets"], [0, 2, 4])
        np.testing.assert_allclose(file["t_camera_world"], -CENTRES)


def test_poses_come_back_as_those_of_cameras(tmp_path):
    path = tmp_path / "answer.npz"
    matrix = np.concatenate([np.eye(3), -CENTRES[1][:, None]], axis=1)
    np.savez(path, T_camera_world=matrix[None])
    np.testing.assert_allclose(read_poses(path, 1).translation, CENTRES[1:])


def test_an_answer_that_is_none_is_refused(tmp_path):
    path = tmp_path / "answer.npz"
    with pytest.raises(NoAnswerError, match="no file"):
        read_poses(path, 1)
    np.savez(path, T_camera_world=np.full((1, 3, 4), np.nan))
    with pytest.raises(NoAnswerError) as caught:
        read_poses(path, 1)
    assert caught.value.reason == "PEER_FAILED"


def test_without_its_environment_there_is_no_answer(seen, tmp_path):
    assert not limap_poses.is_installed(tmp_path)
    refined, detected = seen
    with pytest.raises(NotFoundError, match="make limap"):
        adjusted_poses(refined, detected, tmp_path)
