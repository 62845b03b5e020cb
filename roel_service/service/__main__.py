"""`python -m roel_service.service --data DIR`: a server without the command line's conveniences."""

from __future__ import annotations

import argparse
import asyncio
import json
import logging
import sys
from pathlib import Path

from roel_service.errors import RoelError
from roel_service.service.listen import Listen
from roel_service.service.server import Addresses, serve


def main() -> int:
    """Serve; 2 and one line on stderr if that cannot be."""
    parser = argparse.ArgumentParser(prog="python -m roel_service.service")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--host", default="127.0.0.1")
    parser.add_argument("--port", type=int, default=50051)
    parser.add_argument("--insecure", action="store_true")
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    try:
        asyncio.run(
            serve(
                options.data,
                Listen(host=options.host, port=options.port, insecure=options.insecure),
                on_ready=_announce,
            )
        )
    except RoelError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def _announce(addresses: Addresses) -> None:
    sys.stdout.write(json.dumps({"address": addresses.calls}) + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
