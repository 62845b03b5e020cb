"""Serving with encryption and tokens, and commands that meet such a server."""

import json
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from ..service.certificates import Authority

ROEL = Path(sys.executable).with_name("roel")


def roel(*arguments, cwd, environment=None):
    return subprocess.run(
        [ROEL, *arguments], cwd=cwd, capture_output=True, text=True, check=False, env=environment
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Certificates, and the folder `data` with a token for a reader."""
    folder = tmp_path_factory.mktemp("secure")
    authority = Authority(folder)
    authority.signed("server", "DNS:localhost,IP:127.0.0.1")
    command = ("admin", "token", "create", "ops", "--role", "reader", "--days", "30")
    made = roel(*command, "--data", "data", cwd=folder)
    assert (made.returncode, made.stderr) == (0, "")
    (folder / "token").write_text(made.stdout)
    return folder


@pytest.fixture(scope="module")
def server(folder):
    """Address of a server that speaks TLS, and its admin address."""
    command = [ROEL, "serve", "--data", "data", "--port", "0", "--log-format", "json"]
    command += ["--log-level", "info", "--admin", "127.0.0.1:0"]
    command += ["--tls-cert", "server.pem", "--tls-key", "server.key"]
    with (folder / "log").open("w") as log:
        process = subprocess.Popen(
            command, cwd=folder, stdout=subprocess.PIPE, stderr=log, text=True
        )
    with process:
        told = json.loads(process.stdout.readline())
        yield told["address"]
        assert told["admin"].startswith("127.0.0.1:")
        process.send_signal(signal.SIGTERM)
        assert process.wait(60) == 0
    log = (folder / "log").read_text().splitlines()
    assert [json.loads(line)["message"] for line in log][-1] == "draining"


def test_health_is_asked_with_encryption(folder, server):
    done = roel("health", "--server", server, "--ca", "ca.pem", cwd=folder)
    assert (done.returncode, done.stdout) == (0, "SERVING\n")


def test_a_server_that_nobody_known_vouches_for_is_not_believed(folder, server):
    done = roel("health", "--server", server, "--tls", cwd=folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(f"roel: error: {server}: expected ")


def test_tokens_are_listed_without_their_secrets(folder):
    token = (folder / "token").read_text().strip()
    assert token.startswith("roel_")
    done = roel("admin", "token", "list", "--data", "data", "--json", cwd=folder)
    (told,) = json.loads(done.stdout)["tokens"]
    assert (told["name"], told["role"]) == ("ops", "reader")
    assert told["expires"] > told["created"]
    assert token not in done.stdout


def test_a_token_is_revoked_once(folder):
    create = ("admin", "token", "create", "gone", "--role", "builder", "--data", "data")
    assert roel(*create, "--json", cwd=folder).returncode == 0
    assert roel(*create, cwd=folder).returncode == 2
    revoke = ("admin", "token", "revoke", "gone", "--data", "data")
    assert roel(*revoke, cwd=folder).stdout == "gone is let in no longer\n"
    again = roel(*revoke, cwd=folder)
    assert again.stderr == "roel: error: gone: expected a principal, found none of that name\n"


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (("--cert", "server.pem"), "--cert: expected --cert and --key together, found not both"),
        (("--ca", "none.pem"), "none.pem: expected a file that can be read, found "),
        (("--token-file", "empty"), "empty: expected one line with a token, found none"),
    ],
)
def test_what_cannot_be_used_to_meet_a_server_is_named(folder, options, said):
    (folder / "empty").write_text("\n")
    done = roel("health", "--server", "127.0.0.1:9", *options, cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith(f"roel: error: {said}")


def test_serving_with_half_of_the_files_is_refused(folder):
    done = roel("serve", "--data", "other", "--tls-cert", "server.pem", cwd=folder)
    assert done.returncode == 2
    assert done.stderr.startswith("roel: error: --tls-cert: expected --tls-cert and --tls-key")
    assert not (folder / "other").exists()
