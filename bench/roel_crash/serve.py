"""`python -m roel_crash.serve FOLDER PORT`: a server whose builds are those of `work`."""

import asyncio
import logging
import sys
from pathlib import Path


def main() -> None:
    """Serve until killed; the port goes to stdout."""
    # Children import this module again; they have no use for the server.
    from roel_service.service.listen import Listen
    from roel_service.service.server import Addresses, serve
    from roel_service.service.settings import Settings

    folder, port = Path(sys.argv[1]), int(sys.argv[2])
    logging.basicConfig(level=logging.INFO)
    settings = Settings(
        build_entrypoint="roel_crash.work:build",
        retry_delay_s=0.05,
        # Between a file and the row that names it lie milliseconds here: sweeps have work to do.
        sweep_interval_s=0.5,
        longest_upload_s=10.0,
        # A checker that was left without a server for long gives up its upload. The build that
        # follows it would keep one of the two children from everybody else for ten minutes.
        follow_patience_s=5.0,
    )

    def announce(addresses: Addresses) -> None:
        print(addresses.calls.rpartition(":")[2], flush=True)

    asyncio.run(serve(folder, Listen(port=port), on_ready=announce, settings=settings))


if __name__ == "__main__":
    main()
