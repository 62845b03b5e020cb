"""Results of stages as files: a cache that may be lost, never one that may be wrong."""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import time
import uuid
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

import roel_service
from roel_service.arrays import Array
from roel_service.failpoints import failpoint
from roel_service.mapping.stage_cache import Arrays

# What a result depends on beside parameters and recording.
CODE_FOLDERS = ("config", "geometry", "mapping", "pano_loc", "register", "scene")
SUFFIX = ".stage"

# Fast: most of the bytes are floating-point numbers without pattern.
LEVEL = 1


class StageFiles:
    """Entries of one recording in a folder that all recordings share.

    Args:
        folder: made when something is kept.
        recording: digest of everything that is read: events, poses, camera.
        max_bytes: of all files; those that were not used for the longest time go first.
    """

    def __init__(self, folder: Path, recording: str, max_bytes: int) -> None:
        self._folder = folder
        self._recording = recording
        self._max_bytes = max_bytes

    def get(self, stage: str, parameters: Any) -> Arrays | None:
        """What was kept; None also if it is damaged."""
        path = self._path(stage, parameters)
        try:
            data = path.read_bytes()
            _mark_used(path)
        except FileNotFoundError:
            return None
        return _decoded(data)

    def keep(self, stage: str, parameters: Any, found: Arrays) -> None:
        """Keep an entry, in the place of older ones where there is no room."""
        self._folder.mkdir(parents=True, exist_ok=True)
        path = self._path(stage, parameters)
        temporary = path.with_suffix(f".{uuid.uuid4().hex}")
        temporary.write_bytes(_encoded(found))
        _mark_used(temporary)
        # Not made durable: bytes that a power cut damages do not match their digest.
        temporary.rename(path)
        failpoint("stage.cached")
        self._make_room()

    def _path(self, stage: str, parameters: Any) -> Path:
        text = "\n".join([code_digest(), self._recording, stage, repr(parameters)])
        return self._folder / f"{hashlib.sha256(text.encode()).hexdigest()}{SUFFIX}"

    def _make_room(self) -> None:
        found = []
        for path in self._folder.iterdir():
            with contextlib.suppress(FileNotFoundError):
                found.append((path.stat().st_mtime_ns, path.stat().st_size, path))
        excess_bytes = sum(size for _, size, _ in found) - self._max_bytes
        for _, size, path in sorted(found):
            if excess_bytes <= 0:
                return
            path.unlink(missing_ok=True)
            excess_bytes -= size


@cache
def code_digest() -> str:
    """Digest of the sources that calculate: a change of any of them makes all entries useless."""
    root = Path(roel_service.__file__).parent
    digest = hashlib.sha256(roel_service.__version__.encode())
    for folder in CODE_FOLDERS:
        for path in sorted((root / folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def _mark_used(path: Path) -> None:
    """Date a file now; the system's own dates are milliseconds apart, and equal for a while."""
    now_ns = time.time_ns()
    os.utime(path, ns=(now_ns, now_ns))


def _encoded(arrays: Arrays) -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)  # type: ignore[arg-type]
    data = zstandard.ZstdCompressor(LEVEL).compress(buffer.getvalue())
    return hashlib.sha256(data).digest() + data


def _decoded(data: bytes) -> dict[str, Array] | None:
    digest, payload = data[:32], data[32:]
    if hashlib.sha256(payload).digest() != digest:
        return None
    with np.load(io.BytesIO(zstandard.ZstdDecompressor().decompress(payload))) as arrays:
        return dict(arrays)
