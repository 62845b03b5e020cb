"""`roel serve`."""

from __future__ import annotations

import argparse
from pathlib import Path

from roel_client.cli.output import print_text, to_json
from roel_client.cli.parser import Command, Subparsers, command, endpoint, integer, one_of
from roel_client.cli.staging import Staged


def add_commands(subparsers: Subparsers) -> None:
    """Declare `serve`."""
    parser = command(
        subparsers, "serve", "serve maps over gRPC", Command(run=serve, in_child=False)
    )
    parser.add_argument("--data", required=True, metavar="DIR", help="all that the server keeps")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (127.0.0.1)")
    parser.add_argument(
        "--port",
        type=integer(0, 65535),
        default=50051,
        metavar="N",
        help="port to listen on (50051); 0 takes a free one",
    )
    parser.add_argument("--tls-cert", type=Path, metavar="FILE.pem", help="certificate to show")
    parser.add_argument("--tls-key", type=Path, metavar="FILE.pem", help="its key")
    parser.add_argument(
        "--client-ca",
        type=Path,
        metavar="FILE.pem",
        help="let in only clients with a certificate of these authorities",
    )
    parser.add_argument(
        "--insecure",
        action="store_true",
        help="allow a host other than loopback, though calls are not encrypted",
    )
    parser.add_argument(
        "--admin",
        type=endpoint,
        metavar="HOST:PORT",
        help="serve /metrics, /livez and /readyz over HTTP here; port 0 takes a free one",
    )
    parser.add_argument(
        "--log-format",
        type=one_of("json", "text"),
        metavar="FORMAT",
        help="json (one object a line) or text; both with a line for every call at --log-level info",
    )


def serve(options: argparse.Namespace, staged: Staged) -> None:
    """Serve until SIGINT or SIGTERM; one JSON line on stdout says when and where."""
    from roel_client.local import serving

    listen = {
        name: getattr(options, name)
        for name in ("host", "port", "tls_cert", "tls_key", "client_ca", "insecure", "admin")
    }
    with serving.log_format(options.log_format):
        serving.serve(Path(options.data), listen, lambda addresses: print_text(to_json(addresses)))
