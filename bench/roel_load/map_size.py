"""What a map takes in the store, and how fast it is read back.

    python -m roel_load.map_size MAP.rlm [MORE.rlm ...]

Bytes per line count the whole file: lines, their attributes, digests and index. The error bound is
half a step of the file's grid, for each axis.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

import numpy as np

from roel_service.wire.rlm import decode_map

REPEAT_COUNT = 50


def describe(path: Path) -> dict[str, object]:
    """The figures of one file."""
    data = path.read_bytes()
    times_ms = []
    for _ in range(REPEAT_COUNT):
        start_s = time.perf_counter()
        map_file = decode_map(data)
        times_ms.append(1000 * (time.perf_counter() - start_s))
    line_count = len(map_file.line_map)
    return {
        "map": path.name,
        "line_count": line_count,
        "bytes": len(data),
        "bytes_per_line": round(len(data) / line_count, 2),
        "max_error_mm": round(500 * map_file.step_m, 3),
        "read_ms": round(float(np.median(times_ms)), 2),
    }


def main() -> None:
    """Measure, and print the figures as JSON, a line for each map."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("maps", type=Path, nargs="+")
    for path in parser.parse_args().maps:
        json.dump(describe(path), sys.stdout)
        sys.stdout.write("\n")


if __name__ == "__main__":
    main()
