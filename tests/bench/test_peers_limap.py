from __future__ import annotations

import json
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest

from roel_bench.peers import limap
from roel_bench.peers.limap import LIMAP_SETTINGS, LimapSettings, Problem
from roel_bench.peers.limap_lines import (
    FrameLines,
    best_matches,
    centre_lines,
    detected_lines,
    hamming_distances,
)
from roel_service.errors import ConfigError, NoAnswerError, NotFoundError
from roel_service.geometry import se3
from roel_service.geometry.projection import project
from roel_service.geometry.se3 import SE3
from roel_service.mapping.frames import Frames
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventStream
from roel_service.scene.lines import LineObservations, LineTracks
from roel_service.scene.trajectory import Trajectory

CAMERA = Camera(width=346, height=260, fx_px=240, fy_px=240, cx_px=172.5, cy_px=129.5)


def ridge_image(ends: np.ndarray, sigma_px: float = 2.0) -> np.ndarray:
    """An (H, W) uint8 image with a smooth bright ridge along each of (S, 2, 2) segments."""
    y, x = np.mgrid[: CAMERA.height, : CAMERA.width]
    image = np.zeros((CAMERA.height, CAMERA.width))
    for start, end in ends:
        along = (end - start) / np.linalg.norm(end - start)
        across = (x - start[0]) * -along[1] + (y - start[1]) * along[0]
        inside = (x - start[0]) * along[0] + (y - start[1]) * along[1]
        inside = (inside >= 0) & (inside <= np.linalg.norm(end - start))
        image += 255 * inside * np.exp(-0.5 * (across / sigma_px) ** 2)
    return np.clip(image, 0, 255).astype(np.uint8)


RIDGES = np.array(
    [
        [[40.0, 30.0], [300.0, 60.3]],
        [[60.0, 220.0], [75.5, 100.0]],
        [[150.0, 150.0], [280.0, 230.7]],
    ]
)


def test_ridges_become_their_centre_lines():
    found = detected_lines(ridge_image(RIDGES), min_length_px=40.0, max_ridge_px=8.0).segments_px
    assert len(found) == len(RIDGES)
    for start, end in RIDGES:
        along = (end - start) / np.linalg.norm(end - start)
        across_px = np.abs((found - start) @ np.array([-along[1], along[0]])).max(axis=1)
        # LSD is good for a tenth of a pixel on smooth edges; a flank would be 2 px off.
        assert across_px.min() < 0.2


def test_without_merging_both_flanks_stay():
    found = detected_lines(ridge_image(RIDGES), min_length_px=40.0, max_ridge_px=0.0).segments_px
    assert len(found) == 2 * len(RIDGES)


def test_lines_that_face_each_other_across_the_dark_are_two_ridges():
    right_of_one = [[100.0, 50.0], [100.0, 150.0]]  # downwards: bright on the left, x > 100
    left_of_other = [[106.0, 150.0], [106.0, 50.0]]  # upwards: bright on the right, x < 106
    bright_between = np.array([right_of_one, left_of_other])
    assert len(centre_lines(bright_between, 8.0)) == 1
    dark_between = bright_between[:, ::-1]
    np.testing.assert_array_equal(centre_lines(dark_between, 8.0), dark_between)


def test_centre_line_reaches_as_far_as_both_flanks():
    flanks = np.array([[[100.0, 50.0], [100.0, 150.0]], [[104.0, 170.0], [104.0, 60.0]]])
    (line,) = centre_lines(flanks, 8.0)
    np.testing.assert_allclose(np.sort(line, axis=0), [[102.0, 50.0], [102.0, 170.0]], atol=1e-9)


def textured_lines(shift_px: int) -> FrameLines:
    """Ridges among blobs that tell them apart, seen by a camera that moved sideways."""
    rng = np.random.default_rng(2)
    blobs = cv2.GaussianBlur(rng.normal(0.0, 1500.0, (CAMERA.height, CAMERA.width)), (0, 0), 4.0)
    image = np.clip(ridge_image(RIDGES) + np.maximum(blobs, 0.0), 0, 255).astype(np.uint8)
    return detected_lines(np.roll(image, shift_px, axis=1), min_length_px=60.0, max_ridge_px=8.0)


def test_lines_match_themselves_in_a_shifted_frame():
    first, second = textured_lines(0), textured_lines(6)
    matches = best_matches(first, second, 1)
    moved_px = first.segments_px.mean(axis=1) + np.array([6.0, 0.0])
    offsets_px = second.segments_px.mean(axis=1)[:, None] - moved_px
    same = np.argwhere(np.linalg.norm(offsets_px, axis=-1).T < 3.0).tolist()
    assert len(same) >= len(RIDGES)
    assert all(pair in matches.tolist() for pair in same)


def test_match_count_bounds_the_matches_of_every_line():
    rng = np.random.default_rng(0)
    frames = [
        FrameLines(
            segments_px=np.zeros((20, 2, 2)),
            descriptors=rng.integers(0, 256, (2, 20, 32), dtype=np.uint8),
        )
        for _ in range(2)
    ]
    matches = best_matches(*frames, 3)
    bits = hamming_distances(frames[0].descriptors[0], frames[1].descriptors)
    for i, j in matches:
        among_row = bits[i, j] <= np.sort(bits[i])[2]
        among_column = bits[i, j] <= np.sort(bits[:, j])[2]
        assert among_row or among_column
    assert len(matches) >= 3 * 20


def test_either_direction_of_a_line_may_match():
    rng = np.random.default_rng(1)
    bits = rng.integers(0, 256, (5, 32), dtype=np.uint8)
    other = np.stack([rng.integers(0, 256, (5, 32), dtype=np.uint8), bits])
    assert (np.diag(hamming_distances(bits, other)) == 0).all()


def test_frame_without_lines_has_no_matches():
    dark = detected_lines(np.zeros((260, 346), np.uint8), 10.0, 8.0)
    assert len(dark) == 0
    assert len(best_matches(dark, textured_lines(0), 10)) == 0


def frames_at(centres: np.ndarray, yaw_rad: np.ndarray) -> Frames:
    turns = np.stack([np.zeros_like(yaw_rad), yaw_rad, np.zeros_like(yaw_rad)], axis=1)
    return Frames(
        t_us=np.arange(len(centres)) * 100_000,
        T_world_camera=SE3(rotation=se3.rotation_from_vector(turns), translation=centres),
        K=CAMERA.matrix,
        width=CAMERA.width,
        height=CAMERA.height,
    )


def test_neighbours_are_near_and_look_the_same_way():
    centres = np.array([[0.0, 0, 0], [3.0, 0, 0], [1.0, 0, 0], [0.5, 0, 0]])
    yaw_rad = np.array([0.0, 0.2, 0.1, 2.5])
    neighbors = limap.nearest_frames(frames_at(centres, yaw_rad), 5)
    assert [row.tolist() for row in neighbors] == [[2, 1], [2, 0], [0, 1], []]
    assert limap.nearest_frames(frames_at(centres, yaw_rad), 1)[0].tolist() == [2]


def test_lines_of_one_track_match_each_other_in_the_kept_frames():
    frames = frames_at(np.zeros((5, 3)), np.zeros(5))
    frame = np.array([0, 0, 1, 2, 2, 4])
    segments = np.arange(24.0).reshape(6, 2, 2)
    observations = LineObservations(
        frame=frame,
        segments_px=segments,
        polarity=np.ones(6, np.int8),
        normal_speed_px_per_ms=np.zeros(6),
        event_offsets=np.zeros(7, np.int64),
        event_xy_px=np.empty((0, 2)),
        event_dt_us=np.empty(0, np.int64),
    )
    tracks = LineTracks.from_lists([np.array([1, 2, 4, 5]), np.array([0, 3])])
    problem = limap.tracked_problem(frames, observations, tracks, frame_stride=2)
    found = {pair: rows.tolist() for pair, rows in problem.matches.items()}
    assert found == {(0, 1): [[1, 1], [0, 0]], (0, 2): [[1, 0]], (1, 2): [[1, 0]]}
    np.testing.assert_array_equal(np.concatenate(problem.segments_px), segments[[0, 1, 3, 4, 5]])
    np.testing.assert_array_equal(problem.frames.t_us, [0, 200_000, 400_000])


def box_problem(*, exhaustive: bool) -> tuple[Problem, np.ndarray]:
    """Twelve edges of a box seen exactly from ten places."""
    corners = np.array([[x, y, z] for x in (-0.6, 0.6) for y in (-0.4, 0.4) for z in (2.5, 3.3)])
    edges = np.array(
        [[a, b] for i, a in enumerate(corners) for b in corners[i + 1 :] if (a != b).sum() == 1]
    )
    share = np.linspace(-0.5, 0.5, 10)
    centres = np.stack([share, 0.5 * np.sin(4 * share), 0.2 * np.cos(7 * share)], axis=1)
    frames = frames_at(centres, 0.2 * share)
    segments_px = [project(pose.inverse() @ edges, CAMERA.matrix) for pose in poses(frames)]
    same = np.stack([np.arange(len(edges))] * 2, axis=1)
    pairs = [(i, j) for i in range(10) for j in range(i + 1, 10)]
    problem = Problem(
        frames=frames,
        segments_px=segments_px,
        matches={} if exhaustive else dict.fromkeys(pairs, same),
        neighbors=limap.nearest_frames(frames, 9) if exhaustive else [],
    )
    return problem, edges


def poses(frames: Frames) -> list[SE3]:
    return [frames.T_world_camera[i] for i in range(len(frames))]


def test_written_problem_holds_what_the_worker_reads(tmp_path):
    problem, edges = box_problem(exhaustive=False)
    limap.write_problem(tmp_path / "problem.npz", problem, LIMAP_SETTINGS["best_10"])
    with np.load(tmp_path / "problem.npz") as file:
        written = dict(file)
    points_camera = edges @ written["R_camera_world"][3].T + written["t_camera_world"][3]
    fx, fy, cx, cy = written["pinhole_px"]
    pixels = points_camera[..., :2] / points_camera[..., 2:] * [fx, fy] + [cx, cy]
    first, last = written["line_offsets"][3:5]
    np.testing.assert_allclose(written["segments_px"][first:last], pixels, atol=1e-9)
    assert len(written["pairs"]) == len(written["match_offsets"]) - 1 == 45
    assert written["match_offsets"][-1] == len(written["matches"]) == 45 * len(edges)
    assert len(written["neighbors"]) == 0
    options = json.loads(str(written["options"]))
    assert options["triangulation"]["min_length_2d"] == LIMAP_SETTINGS["best_10"].min_length_px


def test_answer_of_a_worker_is_read_back(tmp_path):
    problem, _ = box_problem(exhaustive=True)
    script = tmp_path / "worker.py"
    script.write_text(
        "import sys, numpy as np\n"
        "problem = np.load(sys.argv[1])\n"
        "centres = np.ones((len(problem['t_camera_world']), 2, 3))\n"
        "np.savez(sys.argv[2], segments=centres)\n"
    )
    limap.write_problem(tmp_path / "problem.npz", problem, LimapSettings())
    command = [sys.executable, str(script), str(tmp_path / "problem.npz"), str(tmp_path / "a.npz")]
    limap.run_worker(command, timeout_s=60)
    np.testing.assert_array_equal(limap.read_segments(tmp_path / "a.npz"), np.ones((10, 2, 3)))


def test_failing_worker_is_one_error_in_one_line(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text("raise ValueError('no lines\\nat all')\n")
    with pytest.raises(NoAnswerError, match="exit code 1: at all") as raised:
        limap.run_worker([sys.executable, str(script)], timeout_s=60)
    assert raised.value.reason == "PEER_FAILED"
    assert "\n" not in str(raised.value)


def test_aborting_worker_is_the_same_error(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text("import os\nos.kill(os.getpid(), 9)\n")
    with pytest.raises(NoAnswerError, match="exit code -9: no message"):
        limap.run_worker([sys.executable, str(script)], timeout_s=60)


def test_worker_without_end_is_stopped(tmp_path):
    script = tmp_path / "worker.py"
    script.write_text("import time\ntime.sleep(600)\n")
    with pytest.raises(NoAnswerError, match=r"nothing after 0\.3 s") as raised:
        limap.run_worker([sys.executable, str(script)], timeout_s=0.3)
    assert raised.value.reason == "PEER_TIMEOUT"


@pytest.mark.parametrize("segments", [None, np.ones((3, 6)), np.full((1, 2, 3), np.nan)])
def test_useless_answers_are_refused(tmp_path, segments):
    if segments is not None:
        np.savez(tmp_path / "answer.npz", segments=segments)
    with pytest.raises(NoAnswerError, match="finite segments"):
        limap.read_segments(tmp_path / "answer.npz")


def test_missing_environment_says_how_to_make_it(tmp_path):
    nothing = np.empty(0, np.int64)
    events = EventStream(
        t_us=nothing, x=nothing, y=nothing, polarity=nothing, width=346, height=260
    )
    trajectory = Trajectory(
        t_us=np.array([0, 1]),
        T_world_camera=SE3(rotation=np.stack([np.eye(3)] * 2), translation=np.zeros((2, 3))),
    )
    with pytest.raises(NotFoundError, match="make limap"):
        limap.map_segments(events, trajectory, CAMERA, LimapSettings(), environment=tmp_path)


def test_unknown_source_of_lines_is_refused():
    with pytest.raises(ConfigError, match="lsd, own"):
        LimapSettings(lines="sold2")


needs_limap = pytest.mark.skipif(
    not (limap.ENVIRONMENT / ".installed").exists(), reason="needs the environment of make limap"
)


@needs_limap
@pytest.mark.parametrize("exhaustive", [False, True])
def test_limap_finds_the_edges_of_a_box(exhaustive):
    problem, edges = box_problem(exhaustive=exhaustive)
    settings = replace(LimapSettings(), timeout_s=120)
    segments = limap.solve(problem, settings, limap.ENVIRONMENT / "bin" / "python")
    found = distances_to_lines(segments, edges)
    # LIMAP drops the lines that the cameras move along; of the others it keeps each once.
    assert len(set(found.argmin(axis=1))) == len(segments) >= 9
    # Exact lines in ten views: what remains is the solver's stop at 1e-5 of the cost.
    assert found.min(axis=1).max() < 1e-3


def distances_to_lines(segments: np.ndarray, lines: np.ndarray) -> np.ndarray:
    """(S, L) larger distance of a segment's ends from each infinite line."""
    start, along = lines[:, 0], lines[:, 1] - lines[:, 0]
    along = along / np.linalg.norm(along, axis=1)[:, None]
    ends = segments[:, None] - start[:, None]
    across = ends - (ends * along[:, None]).sum(axis=-1)[..., None] * along[:, None]
    return np.linalg.norm(across, axis=-1).max(axis=-1)
