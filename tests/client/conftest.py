import pytest

from roel_client import Client

from ..service.processes import Server


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = Server(tmp_path_factory.mktemp("server") / "data")
    yield running
    assert running.stop() == 0


@pytest.fixture
def client(server):
    with Client(server.address) as connected:
        yield connected
