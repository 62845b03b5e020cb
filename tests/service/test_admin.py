"""The admin address by itself, and what it makes of nonsense."""

import asyncio

import pytest

from roel_service.errors import UnavailableError
from roel_service.service.admin import REQUEST_BYTES, Probes, admin_server


def answers(*requests, problems=()):
    """Everything that is sent back to each of the requests."""

    async def main():
        probes = Probes(metrics=lambda: "a 1\n", problems=lambda: list(problems))
        async with admin_server("127.0.0.1", 0, probes) as address:
            return [await exchange(address, request) for request in requests]

    return asyncio.run(main())


async def exchange(address, request):
    host, _, port = address.rpartition(":")
    reader, writer = await asyncio.open_connection(host, int(port))
    writer.write(request)
    writer.write_eof()
    answer = await reader.read()
    writer.close()
    return answer.decode()


def test_a_server_with_problems_is_alive_and_not_ready():
    live, ready = answers(
        b"GET /livez HTTP/1.1\r\n\r\n", b"GET /readyz HTTP/1.1\r\n\r\n", problems=["draining"]
    )
    assert live.startswith("HTTP/1.1 200 OK\r\n")
    assert ready.startswith("HTTP/1.1 503 Service Unavailable\r\n")
    assert ready.endswith("\r\n\r\ndraining\n")


def test_metrics_may_be_asked_for_with_a_query():
    (page,) = answers(b"GET /metrics?name=a HTTP/1.0\r\nHost: here\r\n\r\n")
    assert page.endswith("\r\n\r\na 1\n")


def test_nonsense_gets_no_answer_and_does_no_harm():
    nonsense = [b"", b"GET /metr", b"\x16\x03\x01" * 100, b"x" * (2 * REQUEST_BYTES)]
    *silence, page = answers(*nonsense, b"GET /livez HTTP/1.1\r\n\r\n")
    assert silence == ["", "", "", ""]
    assert page.endswith("ok\n")


def test_a_taken_address_is_told():
    async def main():
        probes = Probes(metrics=str, problems=list)
        async with admin_server("127.0.0.1", 0, probes) as address:
            with pytest.raises(UnavailableError, match=address):
                async with admin_server("127.0.0.1", int(address.rpartition(":")[2]), probes):
                    pass

    asyncio.run(main())
