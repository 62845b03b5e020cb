"""How a command meets a server: address, token, encryption."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from roel_client.cli.parser import Parser, address
from roel_service.errors import InputError

if TYPE_CHECKING:
    from roel_client.connection import Tls


def add_server_options(parser: Parser, *, required: bool, what: str) -> None:
    """Declare `--server` and what goes with it."""
    parser.add_argument("--server", required=required, type=address, metavar="HOST:PORT", help=what)
    parser.add_argument(
        "--token-file", metavar="FILE", help="holds the token for the server; or set ROEL_TOKEN"
    )
    parser.add_argument(
        "--tls", action="store_true", help="encrypt; the system's authorities vouch for the server"
    )
    parser.add_argument(
        "--ca", metavar="FILE.pem", help="encrypt; these authorities vouch for the server"
    )
    parser.add_argument("--cert", metavar="FILE.pem", help="certificate to show to the server")
    parser.add_argument("--key", metavar="FILE.pem", help="its key")


def server_options(options: argparse.Namespace) -> dict[str, Any]:
    """Arguments of `Client` beside the address."""
    return {"token": _token(options.token_file), "tls": _tls(options)}


def _token(file: str | None) -> str | None:
    if file is None:
        return os.environ.get("ROEL_TOKEN") or None
    token = _read(file).decode("utf-8", "replace").strip()
    if not token or not token.isascii() or not token.isprintable():
        raise InputError(file, "one line with a token", "none")
    return token


def _tls(options: argparse.Namespace) -> Tls | None:
    from roel_client.connection import Tls

    if (options.cert is None) != (options.key is None):
        raise InputError("--cert", "--cert and --key together", "not both", reason="TLS_INVALID")
    if not (options.tls or options.ca or options.cert):
        return None
    return Tls(
        ca_pem=options.ca and _read(options.ca),
        certificate_pem=options.cert and _read(options.cert),
        key_pem=options.key and _read(options.key),
    )


def _read(file: str) -> bytes:
    try:
        return Path(file).read_bytes()
    except OSError as error:
        raise InputError(file, "a file that can be read", error.strerror or "none") from error
