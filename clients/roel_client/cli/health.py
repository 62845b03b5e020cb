"""`roel health`."""

from __future__ import annotations

import argparse

from roel_client.cli.output import print_text
from roel_client.cli.parser import Command, Subparsers, address, command
from roel_client.cli.staging import Staged
from roel_service.errors import UnavailableError

DEADLINE_S = 3.0


def add_commands(subparsers: Subparsers) -> None:
    """Declare `health`."""
    parser = command(subparsers, "health", "ask a server whether it serves", Command(run=ask))
    parser.add_argument("--server", required=True, type=address, metavar="HOST:PORT")


def ask(options: argparse.Namespace, staged: Staged) -> None:
    """Print `SERVING`, or raise `UnavailableError`."""
    import grpc
    from grpc_health.v1 import health_pb2, health_pb2_grpc

    with grpc.insecure_channel(options.server) as channel:
        try:
            answer = health_pb2_grpc.HealthStub(channel).Check(
                health_pb2.HealthCheckRequest(), timeout=DEADLINE_S
            )
        except grpc.RpcError as error:
            raise UnavailableError(options.server, "a server", error.code().name) from error
    status = health_pb2.HealthCheckResponse.ServingStatus.Name(answer.status)
    if answer.status != health_pb2.HealthCheckResponse.SERVING:
        raise UnavailableError(options.server, "SERVING", status)
    print_text(status)
