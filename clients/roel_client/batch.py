"""Many pictures located in parallel; whoever is interrupted goes on with the rest.

What is known is appended to a journal, a line of JSON for each query; the table is written from it
when nothing is missing.
"""

from __future__ import annotations

import asyncio
import json
import os
from collections.abc import Awaitable, Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from roel_client.retry import may_pass
from roel_service.errors import InputError, RoelError
from roel_service.geometry.se3 import SE3
from roel_service.io.files import read_input
from roel_service.progress import Progress, ProgressCallback
from roel_service.scene.results import PanoLocResult

MAX_MANIFEST_BYTES = 256 << 20
KEYS = {"panorama", "prior"}
# A query whose picture cannot be used; the others have the status of their answer.
FAILED = "FAILED"
# A prior this far off a rotation is rounded text.
MAX_ROTATION_ERROR = 1e-3

Row = dict[str, Any]


@dataclass(frozen=True, eq=False, kw_only=True)
class Query:
    """One picture.

    Attributes:
        index: place in the manifest, from 0.
        panorama: as the manifest has it.
        path: where it is.
        T_prior: first T_world_panorama.
    """

    index: int
    panorama: str
    path: Path
    T_prior: SE3 | None


# The result, name of the map that the best pose is in, and seconds.
Located = tuple[PanoLocResult, str | None, float]
Locate = Callable[[Query], Awaitable[Located]]


def read_manifest(name: str) -> list[Query]:
    """The queries of a manifest: a line each, a path or `{"panorama": path, "prior": 4x4}`.

    Paths are relative to the manifest's folder; empty lines and `#` comments are left out.

    Raises:
        InputError: MANIFEST_INVALID, or no readable file.
    """
    text = read_input(Path(name), MAX_MANIFEST_BYTES).decode("utf-8", "replace")
    lines = [line.strip() for line in text.splitlines()]
    entries = [_entry(line, name) for line in lines if line and not line.startswith("#")]
    if not entries:
        raise InputError(name, "at least one query", "none", reason="MANIFEST_INVALID")
    return [
        Query(
            index=index,
            panorama=entry["panorama"],
            path=Path(name).parent / entry["panorama"],
            T_prior=_prior(entry.get("prior"), name),
        )
        for index, entry in enumerate(entries)
    ]


def _entry(line: str, name: str) -> dict[str, Any]:
    if not line.startswith("{"):
        return {"panorama": line}
    try:
        entry = json.loads(line)
    except ValueError:
        entry = {}
    if not isinstance(entry.get("panorama"), str) or not entry.keys() <= KEYS:
        expected = "a path or an object with panorama and, perhaps, prior"
        raise InputError(name, expected, line[:80], reason="MANIFEST_INVALID")
    return dict(entry)


def _prior(rows: Any, name: str) -> SE3 | None:
    if rows is None:
        return None
    expected = "a prior of four rows of four numbers, a rigid transform"
    try:
        matrix = np.array(rows, dtype=np.float64)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
        raise InputError(name, expected, f"{rows}"[:80], reason="MANIFEST_INVALID")
    left, _, right = np.linalg.svd(matrix[:3, :3])
    rotation = left @ right
    if np.abs(rotation - matrix[:3, :3]).max() > MAX_ROTATION_ERROR or np.linalg.det(rotation) < 0:
        raise InputError(name, expected, f"{rows}"[:80], reason="MANIFEST_INVALID")
    return SE3(rotation=rotation, translation=matrix[:3, 3])


class Journal:
    """Rows that are known, in a file that only grows.

    Args:
        path: made unless it is there.
        asked: what the rows are answers to, as JSON; the first line of the file.

    Attributes:
        rows: by the index of their query.

    Raises:
        InputError: the file has answers to something else, or cannot be written.
    """

    def __init__(self, path: Path, asked: dict[str, Any]) -> None:
        self.rows: dict[int, Row] = {}
        self._path = path
        whole_bytes = self._read(asked) if path.exists() else 0
        try:
            self._file = path.open("r+b" if path.exists() else "wb")
        except OSError as error:
            found = error.strerror or "none"
            raise InputError(str(path), "a file that can be written", found) from error
        # The line that was being written.
        self._file.truncate(whole_bytes)
        self._file.seek(whole_bytes)
        if whole_bytes == 0:
            self._write(asked)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *error: object) -> None:
        self._file.close()

    def add(self, row: Row) -> None:
        """Keep a row, whatever happens to this process."""
        self.rows[row["index"]] = row
        self._write(row)

    def delete(self) -> None:
        """Everything is in the table."""
        self._path.unlink()

    def _read(self, asked: dict[str, Any]) -> int:
        """Bytes of the whole lines."""
        whole_bytes = 0
        for document, end in _documents(self._path.read_bytes()):
            if whole_bytes == 0 and document != asked:
                expected = "a journal of these queries (delete it to begin anew)"
                raise InputError(str(self._path), expected, "one of others")
            if whole_bytes > 0:
                self.rows[document["index"]] = document
            whole_bytes = end
        return whole_bytes

    def _write(self, document: dict[str, Any]) -> None:
        self._file.write(json.dumps(document).encode() + b"\n")
        self._file.flush()


def _documents(data: bytes) -> Iterator[tuple[dict[str, Any], int]]:
    """Each whole line as a document, and where it ends."""
    end = 0
    for line in data.splitlines(keepends=True):
        if not line.endswith(b"\n"):
            return
        try:
            document = json.loads(line)
        except ValueError:
            return
        end += len(line)
        yield document, end


async def locate_all(
    queries: Sequence[Query],
    locate: Locate,
    journal: Journal,
    *,
    parallel_count: int,
    progress: ProgressCallback,
) -> None:
    """Locate whatever the journal does not know.

    Raises:
        RoelError: one that may pass, such as a server that went away; the journal has the rest.
    """
    waiting = iter([query for query in queries if query.index not in journal.rows])

    async def worker() -> None:
        for query in waiting:
            journal.add(await _row(query, locate))
            progress(_progress(len(journal.rows), len(queries)))

    progress(_progress(len(journal.rows), len(queries)))
    async with asyncio.TaskGroup() as workers:
        for _ in range(parallel_count):
            workers.create_task(worker())


async def _row(query: Query, locate: Locate) -> Row:
    try:
        return located_row(query, *await locate(query))
    except RoelError as error:
        if may_pass(error):
            raise
        return failed_row(query, error)


def located_row(query: Query, result: PanoLocResult, map_name: str | None, seconds: float) -> Row:
    """What became of a query."""
    best = result.hypotheses[0] if result.hypotheses else None
    return {
        **_empty_row(query),
        "status": result.status.value,
        "reason": None if result.reason is None else result.reason.value,
        "map": map_name,
        "T_world_panorama": None if best is None else _flat(best.T_world_panorama.matrix()),
        "score": result.score,
        "covariance": None if best is None else _flat(best.covariance),
        "alternative_count": max(0, len(result.hypotheses) - 1),
        "seconds": seconds,
    }


def failed_row(query: Query, error: RoelError) -> Row:
    """The same for a query that has no answer."""
    return {**_empty_row(query), "reason": error.reason, "error": str(error)}


def _empty_row(query: Query) -> Row:
    return {
        "index": query.index,
        "panorama": query.panorama,
        "status": FAILED,
        "reason": None,
        "map": None,
        "T_world_panorama": None,
        "score": None,
        "covariance": None,
        "alternative_count": 0,
        "seconds": None,
        "error": None,
    }


def _flat(matrix: Any) -> list[float]:
    numbers: list[float] = np.asarray(matrix).ravel().tolist()
    return numbers


def _progress(done_count: int, total_count: int) -> Progress:
    return Progress(
        stage="localize",
        done_count=done_count,
        total_count=total_count,
        fraction=done_count / total_count,
    )


def write_table(rows: Sequence[Row], path: Path) -> None:
    """Write rows in the format that the suffix names, so that the file is whole or not there.

    Raises:
        InputError: `.parquet` without the extra that writes it.
    """
    from roel_service.io.files import whole_file

    with whole_file(path) as temporary:
        if path.suffix == ".jsonl":
            temporary.write_text("".join(f"{json.dumps(row)}\n" for row in rows), encoding="utf-8")
        else:
            _write_parquet(rows, temporary)


def require_parquet(name: str) -> None:
    """Raise `InputError` unless Parquet files can be written; `name` is the file's."""
    try:
        import pyarrow.parquet  # noqa: F401 - only whether it is there
    except ImportError as error:
        expected = "the extra parquet for .parquet files (pip install 'roel-service[parquet]')"
        raise InputError(name, expected, "none") from error


def _write_parquet(rows: Sequence[Row], path: Path) -> None:
    import pyarrow
    from pyarrow import parquet

    schema = pyarrow.schema(
        {
            "index": pyarrow.int64(),
            "panorama": pyarrow.string(),
            "status": pyarrow.string(),
            "reason": pyarrow.string(),
            "map": pyarrow.string(),
            "T_world_panorama": pyarrow.list_(pyarrow.float64(), 16),
            "score": pyarrow.float64(),
            "covariance": pyarrow.list_(pyarrow.float64(), 36),
            "alternative_count": pyarrow.int64(),
            "seconds": pyarrow.float64(),
            "error": pyarrow.string(),
        }
    )
    table = pyarrow.Table.from_pylist(list(rows), schema=schema)
    parquet.write_table(table, path, compression="zstd")


def default_worker_count() -> int:
    """One for each core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
