"""The client without an event loop says what the one for asyncio says."""

import inspect
import subprocess
import sys
from pathlib import Path

import pytest

from roel_client import aio, client, connection

ROOT = Path(__file__).resolve().parents[2]
TWINS = (
    (aio.AsyncClient, client.Client),
    (aio.AsyncOperation, client.Operation),
    (connection.AsyncConnection, connection.Connection),
    (connection.AsyncExchange, connection.Exchange),
)


def test_the_generated_client_is_current():
    command = [sys.executable, ROOT / "clients/generate.py", "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize(("asynchronous", "synchronous"), TWINS)
def test_both_have_the_same_methods_with_the_same_arguments(asynchronous, synchronous):
    def methods(kind):
        found = inspect.getmembers(kind, inspect.isfunction)
        public = [(name, method) for name, method in found if not name.startswith("_")]
        return {name: list(inspect.signature(method).parameters) for name, method in public}

    assert methods(asynchronous) == methods(synchronous)
    assert methods(synchronous)


def test_no_word_of_asyncio_is_left():
    source = Path(client.__file__).read_text()
    assert not {"async", "await", "asyncio"} & set(source.replace("(", " ").split())
