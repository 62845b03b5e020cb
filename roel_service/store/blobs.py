"""Immutable files named by the SHA-256 of their bytes."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections.abc import Collection, Iterator
from pathlib import Path

from roel_service.errors import CorruptionError
from roel_service.store.files import make_folder, sync_file, sync_folder


class BlobStore:
    """Blobs below one folder, at `ab/cd/<hex>`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        make_folder(folder)

    def path(self, sha256: str) -> Path:
        """Where a blob is, or would be."""
        return self._folder / sha256[:2] / sha256[2:4] / sha256

    def put(self, data: bytes) -> str:
        """Store bytes durably; the digest that names them."""
        temporary = self._folder / f"{uuid.uuid4().hex}.part"
        try:
            temporary.write_bytes(data)
            return self.adopt(temporary)
        finally:
            temporary.unlink(missing_ok=True)

    def adopt(self, source: Path) -> str:
        """Store a file of the same file system durably; its own name stays for the caller."""
        with source.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        target = self.path(sha256)
        if not target.exists():
            sync_file(source)
            make_folder(target.parent)
            # A link appears whole or not at all, as a rename does, and survives a retry.
            os.link(source, target)
            sync_folder(target.parent)
        return sha256

    def read(self, sha256: str) -> bytes:
        """The bytes of a blob.

        Raises:
            CorruptionError: the file is gone, or is no longer what its name says.
        """
        path = self.path(sha256)
        data = path.read_bytes() if path.exists() else b""
        found = hashlib.sha256(data).hexdigest()
        if found != sha256:
            raise CorruptionError(f"blob {sha256}", "bytes of that digest", found)
        return data

    def delete(self, sha256: str) -> None:
        """Forget a blob; one that is not there is fine."""
        self.path(sha256).unlink(missing_ok=True)

    def sweep(self, keep: Collection[str]) -> None:
        """Delete all but some blobs, and what interrupted writes left."""
        for path in self._files():
            if path.name not in keep:
                path.unlink()

    def _files(self) -> Iterator[Path]:
        return (path for path in self._folder.rglob("*") if path.is_file())
