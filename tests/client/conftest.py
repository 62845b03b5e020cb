import pytest

from roel_client import Client

from ..service.processes import Server, servers


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    running = Server(tmp_path_factory.mktemp("server") / "data")
    yield running
    assert running.stop() == 0


@pytest.fixture
def client(server):
    with Client(server.address) as connected:
        yield connected


@pytest.fixture
def start_server(tmp_path):
    """Starts a server on the test's own data folder."""
    with servers(tmp_path / "data") as start:
        yield start
