import pytest

from roel_client import Client
from roel_client.connection import Connection, Endpoint

from .processes import Server, servers


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """One server for the tests of a module; small limits, so that they can be met."""
    running = Server(
        tmp_path_factory.mktemp("server") / "data",
        concurrent_builds=1,
        queued_builds=1,
        pose_count=100,
        event_stream_bytes=600_000,
    )
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="module")
def client(server):
    with Client(server.address) as connected:
        yield connected


@pytest.fixture(scope="module")
def connection(server):
    """For calls that the client does not make."""
    opened = Connection(Endpoint(address=server.address))
    yield opened
    opened.close()


@pytest.fixture
def start_server(tmp_path):
    """Starts a server on the test's own data folder."""
    with servers(tmp_path / "data") as start:
        yield start
