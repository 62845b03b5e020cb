"""`python -m roel_crash`."""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

from roel_crash.run import crash


def main() -> int:
    """Kill, print what came of it; 1 if a promise was broken or a named step never met."""
    parser = argparse.ArgumentParser(prog="python -m roel_crash")
    parser.add_argument("--kills", type=int, default=210)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="a JSON list, to which the outcome is added")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        with Path(folder, "server.log").open("ab") as log:
            outcome = crash(Path(folder, "data"), options.kills, options.seed, log)
        text = json.dumps(outcome.document(), indent=1)
        if outcome.broken:
            print(Path(folder, "server.log").read_text()[-20_000:], file=sys.stderr)
    if options.out is not None:
        earlier = json.loads(options.out.read_text()) if options.out.exists() else []
        options.out.write_text(json.dumps([*earlier, outcome.document()], indent=1) + "\n")
    print(text)
    return 1 if outcome.broken or outcome.missed else 0


if __name__ == "__main__":
    sys.exit(main())
