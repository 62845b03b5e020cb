"""A server whose builds are those of `sample_builds`; settings come as JSON."""

import asyncio
import json
import logging
import sys
from pathlib import Path

from roel_service.service.server import serve
from roel_service.service.settings import Settings


def announce(address):
    sys.stdout.write(address + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    logging.basicConfig(level=logging.INFO)
    folder, port, settings = sys.argv[1:]
    chosen = {"build_entrypoint": "sample_builds:build", **json.loads(settings)}
    asyncio.run(
        serve(Path(folder), "127.0.0.1", int(port), on_ready=announce, settings=Settings(**chosen))
    )
