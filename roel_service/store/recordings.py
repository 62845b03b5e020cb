"""Append files: the chunks of recordings that are still open, one file each."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from roel_service.failpoints import failpoint
from roel_service.store.files import make_folder, sync_folder


class Recordings:
    """Append files below one folder, named by the uid of their stream."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        make_folder(folder)

    def path(self, uid: str) -> Path:
        """The append file of a stream."""
        return self._folder / f"{uid}.rec"

    def create(self, uid: str) -> None:
        """Make an empty append file."""
        self.path(uid).touch()
        sync_folder(self._folder)
        failpoint("recording.created")

    def append(self, uid: str, committed_bytes: int, chunks: Iterable[bytes]) -> None:
        """Write chunks durably behind the committed bytes; what lay there was never committed."""
        with self.path(uid).open("r+b") as file:
            file.truncate(committed_bytes)
            file.seek(committed_bytes)
            file.writelines(chunks)
            file.flush()
            failpoint("recording.written")
            os.fsync(file.fileno())
            failpoint("recording.synced")

    def replace(self, uid: str, source: Path) -> None:
        """Let a durable file of the same file system be the append file."""
        source.replace(self.path(uid))
        sync_folder(self._folder)

    def cut(self, uid: str, committed_bytes: int) -> Path:
        """Drop what was never committed; the file that holds the rest."""
        os.truncate(self.path(uid), committed_bytes)
        return self.path(uid)

    def delete(self, uid: str) -> None:
        """Forget an append file; one that is not there is fine."""
        self.path(uid).unlink(missing_ok=True)

    def sweep(self, committed_bytes: Mapping[str, int]) -> None:
        """Cut the files of some streams to what was committed, and delete all others."""
        for path in self._folder.iterdir():
            if path.stem not in committed_bytes:
                path.unlink()
            elif path.stat().st_size > committed_bytes[path.stem]:
                self.cut(path.stem, committed_bytes[path.stem])
