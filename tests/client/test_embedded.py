"""A server in the client's own process answers as one far away does."""

import asyncio
from pathlib import Path

import pytest

from roel_client import AsyncClient, Client
from roel_service.config.presets import preset
from roel_service.errors import StateError
from roel_service.jobs.build import build_map
from roel_service.store.principals import Role
from roel_service.store.store import opened_principals

from ..jobs import wireframe

INPUTS = (wireframe.events(), wireframe.trajectory(), wireframe.CAMERA, preset("default"))


def listening_ports():
    """TCP ports on which this process's network listens."""
    tables = [Path("/proc/self/net/tcp").read_text(), Path("/proc/self/net/tcp6").read_text()]
    rows = [line.split() for table in tables for line in table.splitlines()[1:]]
    inodes = {str(path.readlink()) for path in Path("/proc/self/fd").iterdir() if path.is_symlink()}
    return [row[1] for row in rows if row[3] == "0A" and f"socket:[{row[9]}]" in inodes]


def test_an_embedded_server_builds_the_map_that_a_process_builds(tmp_path):
    with Client.embedded(tmp_path / "data") as client:
        rlm_bytes, _ = client.map_recording(*INPUTS)
        assert listening_ports() == []
    assert rlm_bytes == build_map(*INPUTS).rlm_bytes


def test_what_was_kept_is_there_again(tmp_path):
    with Client.embedded(tmp_path / "data") as client:
        name = client.create_map("house")

    async def kept():
        async with AsyncClient.embedded(tmp_path / "data") as client:
            return await client.create_event_stream("walk", wireframe.CAMERA)

    assert name == "projects/default/maps/house"
    assert asyncio.run(kept()) == "projects/default/eventStreams/walk"


def test_a_folder_in_use_is_refused(tmp_path):
    with (
        Client.embedded(tmp_path / "data"),
        pytest.raises(StateError) as caught,
        Client.embedded(tmp_path / "data"),
    ):
        pass
    assert caught.value.reason == "DATA_IN_USE"


def test_whoever_embeds_the_server_needs_no_token(tmp_path):
    with opened_principals(tmp_path / "data") as principals:
        principals.create("robot-1", Role.READER)
    with Client.embedded(tmp_path / "data") as client:
        assert client.create_map("house")
