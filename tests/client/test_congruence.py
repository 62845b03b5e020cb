"""A map built by a server is, byte for byte, the one built in process."""

import json
import subprocess
import sys

import pytest

from roel_client import Client
from roel_service.config.presets import preset
from roel_service.jobs.build import build_map

from ..jobs import wireframe


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
