"""Who is let in: certificates, tokens, roles."""

import sqlite3

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from roel_client import Client, RetryPolicy, Tls
from roel_service.errors import (
    InputError,
    PermissionDeniedError,
    UnauthenticatedError,
    UnavailableError,
)
from roel_service.service.access import Directory, is_local_peer
from roel_service.service.listen import Listen
from roel_service.service.rules import RULES, UNLISTED, Rule, rule_of
from roel_service.store.principals import Principal, Role
from roel_service.store.store import opened_principals

from .certificates import Authority
from .processes import CAMERA, Server, new_id, wait_until

ONCE = RetryPolicy(attempt_count=1)


@pytest.fixture(scope="module")
def authority(tmp_path_factory):
    return Authority(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def files(authority):
    return authority.signed("server", "DNS:localhost,IP:127.0.0.1")


@pytest.fixture(scope="module")
def tokens():
    """Tokens by the roles they were made for."""
    return {}


@pytest.fixture(scope="module")
def secure(tmp_path_factory, authority, files, tokens):
    """A server that speaks TLS, knows certificates and has a principal of each role."""
    folder = tmp_path_factory.mktemp("secure") / "data"
    with opened_principals(folder) as principals:
        for role in Role:
            tokens[role] = principals.create(f"the-{role.label}", role)
        principals.create("robot-1", Role.BUILDER)
    listen = {
        "tls_cert": str(files.certificate),
        "tls_key": str(files.key),
        "host": "localhost",
    }
    running = Server(folder, listen=listen)
    yield running
    assert running.stop() == 0


@pytest.fixture(scope="module")
def tls(authority):
    return Tls(ca_pem=authority.own.certificate.read_bytes())


@pytest.fixture
def as_role(secure, tokens, tls):
    """A client with the token of a role."""
    opened = []

    def connected(role):
        opened.append(Client(secure.address, token=tokens[role], tls=tls, retry=ONCE))
        return opened[-1]

    yield connected
    for client in opened:
        client.close()


def test_every_method_has_a_rule(server):
    with Client(server.address) as client:
        served = {f"/{method.name}" for method in client.capabilities().methods}
    assert set(RULES) == served


def test_whoever_only_localizes_never_gets_a_map():
    for method, rule in RULES.items():
        if rule.role is Role.LOCALIZE_ONLY:
            assert "Map" not in method.rpartition("/")[2]
            assert not rule.audited


def test_what_has_no_rule_is_for_the_admin():
    assert rule_of("/roel_service.v1.MapService/Future") is UNLISTED
    assert Rule(role=Role.ADMIN, audited=True) == UNLISTED


def test_a_builder_changes_and_a_reader_looks(as_role):
    stream = as_role(Role.BUILDER).create_event_stream(new_id(), CAMERA)
    assert as_role(Role.READER).event_stream(stream).name == stream
    assert as_role(Role.ADMIN).event_stream(stream).name == stream


@pytest.mark.parametrize(
    ("role", "call"),
    [
        (Role.READER, lambda client: client.create_map("house")),
        (Role.READER, lambda client: client.delete_map("not even a name")),
        (Role.LOCALIZE_ONLY, lambda client: client.download_map("projects/default/maps/x")),
        (Role.LOCALIZE_ONLY, lambda client: client.operation("operations/x").wait()),
    ],
)
def test_a_role_does_no_more_than_it_may(as_role, role, call):
    """Nothing is said of what the request names, not even that it is no name."""
    with pytest.raises(PermissionDeniedError) as caught:
        call(as_role(role))
    assert caught.value.reason == "PERMISSION_DENIED"
    assert caught.value.found == role.label


def test_whoever_only_localizes_may_ask_what_the_server_takes(as_role):
    assert as_role(Role.LOCALIZE_ONLY).capabilities().limits.pose_count > 0


@pytest.mark.parametrize("token", [None, "roel_wrong", ""])
def test_without_a_known_token_nobody_is_let_in(secure, tls, token):
    with (
        Client(secure.address, token=token, tls=tls, retry=ONCE) as client,
        pytest.raises(UnauthenticatedError) as caught,
    ):
        client.capabilities()
    assert caught.value.reason == "UNAUTHENTICATED"


def test_tokens_are_made_and_revoked_while_the_server_runs(secure, tls):
    with opened_principals(secure.folder) as principals:
        token = principals.create("for-a-moment", Role.READER)
    with Client(secure.address, token=token, tls=tls, retry=ONCE) as client:

        def is_known():
            try:
                client.capabilities()
            except UnauthenticatedError:
                return False
            return True

        wait_until(is_known)
        with opened_principals(secure.folder) as principals:
            principals.revoke("for-a-moment")
        wait_until(lambda: not is_known())


def test_of_a_certificates_names_the_first_that_is_known_decides():
    names = [Principal(name=name, role=Role.READER) for name in ("robot-1", "spiffe://fleet/2")]
    gone = Principal(name="gone", role=Role.ADMIN, expire_time_us=1)
    directory = Directory([*names, gone])
    assert directory.of_names(["gone", "other", "spiffe://fleet/2", "robot-1"]) is names[1]
    assert directory.of_names([]) is None


def test_health_is_for_everybody(secure, tls):
    with grpc.secure_channel(secure.address, tls.credentials()) as channel:
        request = health_pb2.HealthCheckRequest()
        answer = health_pb2_grpc.HealthStub(channel).Check(request, timeout=10)
    assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_plain_text_is_not_spoken(secure, tokens):
    with (
        Client(secure.address, token=tokens[Role.ADMIN], retry=ONCE) as client,
        pytest.raises(UnavailableError),
    ):
        client.capabilities()


def test_a_server_of_another_authority_is_not_believed(secure, tokens, tmp_path):
    other = Tls(ca_pem=Authority(tmp_path).own.certificate.read_bytes())
    with (
        Client(secure.address, token=tokens[Role.ADMIN], tls=other, retry=ONCE) as client,
        pytest.raises(UnavailableError),
    ):
        client.capabilities()


def test_every_change_leaves_a_row_in_the_audit(secure, as_role):
    stream = as_role(Role.BUILDER).create_event_stream(new_id(), CAMERA)
    as_role(Role.READER).event_stream(stream)
    with pytest.raises(PermissionDeniedError):
        as_role(Role.READER).delete_event_stream(stream)
    as_role(Role.BUILDER).delete_event_stream(stream)
    rows = sqlite3.connect(secure.folder / "rows.sqlite")
    found = rows.execute(
        "SELECT principal, method, resource, code FROM audit ORDER BY id DESC LIMIT 3"
    ).fetchall()
    rows.close()
    service = "/roel_service.v1.EventStreamService"
    assert found == [
        ("the-builder", f"{service}/DeleteEventStream", stream, "OK"),
        ("the-reader", f"{service}/DeleteEventStream", stream, "PERMISSION_DENIED"),
        ("the-builder", f"{service}/CreateEventStream", "projects/default", "OK"),
    ]


@pytest.fixture(scope="module")
def mutual(tmp_path_factory, authority, files):
    """A server that asks for certificates, and knows `robot-1`."""
    folder = tmp_path_factory.mktemp("mutual") / "data"
    with opened_principals(folder) as principals:
        principals.create("robot-1", Role.BUILDER)
    listen = {
        "tls_cert": str(files.certificate),
        "tls_key": str(files.key),
        "client_ca": str(authority.own.certificate),
    }
    running = Server(folder, listen=listen)
    yield running
    assert running.stop() == 0


def client_tls(authority, name, alternative_names):
    signed = authority.signed(name, alternative_names)
    return Tls(
        ca_pem=authority.own.certificate.read_bytes(),
        certificate_pem=signed.certificate.read_bytes(),
        key_pem=signed.key.read_bytes(),
    )


def test_a_certificate_names_its_owner(mutual, authority):
    robot = client_tls(authority, "some-name", "DNS:robot-1")
    with Client(mutual.address, tls=robot, retry=ONCE) as client:
        assert client.create_map("house").endswith("/house")


def test_a_certificate_of_nobody_known_opens_nothing(mutual, authority):
    stranger = client_tls(authority, "stranger", "DNS:robot-2")
    with (
        Client(mutual.address, tls=stranger, retry=ONCE) as client,
        pytest.raises(UnauthenticatedError, match="certificate of nobody known"),
    ):
        client.capabilities()


def test_without_a_certificate_there_is_no_connection(mutual, tls):
    with (
        Client(mutual.address, tls=tls, retry=ONCE) as client,
        pytest.raises(UnavailableError),
    ):
        client.capabilities()


def test_files_that_are_no_certificate_are_refused(files, tmp_path):
    noise = tmp_path / "noise.pem"
    noise.write_text("noise")
    for wrong in (
        {"tls_cert": files.certificate},
        {"tls_cert": noise, "tls_key": files.key},
        {"tls_cert": files.certificate, "tls_key": tmp_path / "none.pem"},
        {"tls_cert": files.certificate, "tls_key": files.key, "client_ca": noise},
        {"client_ca": noise},
    ):
        with pytest.raises(InputError) as caught:
            Listen(**wrong).credentials()
        assert caught.value.reason == "TLS_INVALID"


@pytest.mark.parametrize(
    ("peer", "local"),
    [
        ("ipv4:127.0.0.1:5000", True),
        ("ipv6:%5B::1%5D:5000", True),
        ("ipv4:192.0.2.1:5000", False),
        ("ipv6:%5B2001:db8::1%5D:5000", False),
    ],
)
def test_local_peers_are_those_of_this_machine(peer, local):
    assert is_local_peer(peer) is local
