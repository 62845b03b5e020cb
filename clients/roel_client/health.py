"""Whether a server serves."""

from __future__ import annotations

from grpc_health.v1 import health_pb2, health_pb2_grpc

from roel_client.connection import Connection, Endpoint, Tls
from roel_client.retry import NO_RETRY


def check_health(
    address: str, timeout_s: float, *, token: str | None = None, tls: Tls | None = None
) -> str:
    """What the server says of itself, such as `SERVING`; raises `UnavailableError`."""
    connection = Connection(
        Endpoint(address=address, token=token, tls=tls, timeout_s=timeout_s, retry=NO_RETRY)
    )
    try:
        stub = health_pb2_grpc.HealthStub(connection.channel)
        answer = connection.call(stub.Check, health_pb2.HealthCheckRequest())
    finally:
        connection.close()
    return str(health_pb2.HealthCheckResponse.ServingStatus.Name(answer.status))
