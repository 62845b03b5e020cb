"""What a server makes is, byte for byte, what is made in process."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest

from roel_client import Client
from roel_service.config.presets import preset
from roel_service.errors import ConfigError, InputError, NotFoundError, StateError
from roel_service.jobs.build import build_map
from roel_service.jobs.refinement import refine_poses
from roel_service.scene.lines import LineMap
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import decode_map, encode_map

from ..jobs import wireframe
from ..mapping.synthetic import CAMERA, SEGMENTS_WORLD, event_stream
from ..mapping.test_pipeline import CONFIG
from ..mapping.test_refine_poses import noisy_trajectory


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data")
    command = [sys.executable, "-m", "roel_service.service", "--data", folder, "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE) as process:
        yield json.loads(process.stdout.readline())["address"]
        process.terminate()
        assert process.wait(30) == 0


@pytest.mark.parametrize("name", ["default", "paper"])
def test_server_and_process_build_equal_files_and_reports(address, name):
    events, config = wireframe.events(), preset(name)
    inputs = (events, wireframe.trajectory(), wireframe.CAMERA, config)
    here = build_map(*inputs)
    with Client(address) as client:
        rlm_bytes, report = client.map_recording(*inputs)
    assert rlm_bytes == here.rlm_bytes
    measured = ("seconds", "seconds_total", "peak_rss_mib")
    assert list(report) == list(here.report)
    for key in set(report) - set(measured):
        assert report[key] == here.report[key]


def assert_equal_poses(first, second):
    np.testing.assert_array_equal(first.t_us, second.t_us)
    np.testing.assert_array_equal(first.T_world_camera.matrix(), second.T_world_camera.matrix())


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """The small world as a map file."""
    path = tmp_path_factory.mktemp("world") / "world.rlm"
    path.write_bytes(encode_map(LineMap.from_segments(SEGMENTS_WORLD), Provenance()))
    return path


def test_server_and_process_refine_poses_alike_and_make_a_version_of_the_lines(address, world):
    given = (event_stream(), noisy_trajectory(), CAMERA)
    line_map = decode_map(world.read_bytes()).line_map
    found, report = refine_poses(*given, CONFIG, line_map=line_map)
    with Client(address) as client, client.hosted_map(world) as fixed:
        house = client.create_map("house")
        with client.hosted_recording(*given) as stream:
            operation = client.refine_poses(stream, CONFIG, map_version=fixed, target_map=house)
            answer = operation.wait()
        assert_equal_poses(client.download_poses(answer.trajectory), found.trajectory)
        assert answer.iteration_count == report["iterations"]
        assert answer.mean_shift_m == report["mean_shift_m"]
        assert answer.map_version.trajectory == answer.trajectory
        built = build_map(given[0], found.trajectory, CAMERA, CONFIG)
        assert client.download_map(answer.map_version.name) == built.rlm_bytes


@pytest.mark.parametrize(
    "estimate",
    ["estimate_time_offset", pytest.param("estimate_intrinsics", marks=pytest.mark.slow)],
)
def test_server_and_process_estimate_alike_what_is_off_beside_the_poses(address, world, estimate):
    late = dataclasses.replace(noisy_trajectory(), t_us=noisy_trajectory().t_us + 30_000)
    line_map = decode_map(world.read_bytes()).line_map
    given = (event_stream(), late, CAMERA, CONFIG)
    found, report = refine_poses(*given, line_map=line_map, **{estimate: True})
    with Client(address) as client, client.hosted_map(world) as fixed:
        poses, answer = client.refine_recording(*given, fixed, **{estimate: True})
        with pytest.raises(ConfigError, match=r"refine\.pose_method"):
            client.refine_recording(*given[:3], preset("paper"), **{estimate: True})
    assert_equal_poses(poses, found.trajectory)
    assert answer.time_offset_us == report["time_offset_us"] < -15_000
    assert answer.HasField("focal_scale") == (estimate == "estimate_intrinsics")
    told = [name for name in report if name.startswith(("focal_", "principal_"))]
    assert len(told) == 9
    for name in told:
        assert (getattr(answer, name) or None) == (report[name] or None)


def test_server_and_process_find_equal_poses_of_a_map(address):
    free = dataclasses.replace(CONFIG, refine=dataclasses.replace(CONFIG.refine, free_poses=True))
    inputs = (event_stream(), noisy_trajectory(), CAMERA, free)
    here = build_map(*inputs)
    with Client(address) as client:
        rlm_bytes, _, trajectory = client.map_recording_with_poses(*inputs)
    assert rlm_bytes == here.rlm_bytes
    assert_equal_poses(trajectory, here.trajectory)


def test_refinements_that_cannot_begin_are_refused(address):
    nowhere = "projects/default/maps/nowhere"
    with Client(address) as client:
        stream = client.create_event_stream("open-walk", CAMERA)
        with pytest.raises(StateError) as caught:
            client.refine_poses(stream, CONFIG)
        assert caught.value.reason == "STREAM_NOT_FINALIZED"
        with pytest.raises(NotFoundError):
            client.refine_poses(stream, CONFIG, map_version=f"{nowhere}/versions/v1")
        with pytest.raises(InputError):
            client.refine_poses("nothing", CONFIG)
