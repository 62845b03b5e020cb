"""A server whose builds are those of `sample_builds`; where to listen and settings come as JSON."""

import sys

PATHS = ("tls_cert", "tls_key", "client_ca")


def main():
    # Children import this script again; they have no use for the server.
    import asyncio
    import json
    import logging
    from pathlib import Path

    from roel_service.service.listen import Listen
    from roel_service.service.logs import JsonFormatter
    from roel_service.service.server import serve
    from roel_service.service.settings import Settings

    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter())
    logging.basicConfig(level=logging.INFO, handlers=[handler])
    folder, listen, settings = sys.argv[1:]
    defaults = {"build_entrypoint": "sample_builds:build", "retry_delay_s": 0.05}
    chosen = Settings(**{**defaults, **json.loads(settings)})
    where = {
        name: Path(value) if name in PATHS else value for name, value in json.loads(listen).items()
    }
    serving = serve(Path(folder), Listen(**where), on_ready=announce, settings=chosen)
    asyncio.run(serving)


def announce(addresses):
    sys.stdout.write(f"{addresses.calls} {addresses.admin}\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
