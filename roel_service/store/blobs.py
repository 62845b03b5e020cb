"""Immutable files named by the SHA-256 of their bytes."""

from __future__ import annotations

import contextlib
import hashlib
import os
import uuid
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from roel_service.errors import CorruptionError, NotFoundError
from roel_service.failpoints import failpoint
from roel_service.store.files import make_folder, sync_file, sync_folder


@dataclass(frozen=True, kw_only=True)
class StoredBlob:
    """A blob as it lies there.

    Attributes:
        used_s: when it was put last, seconds since 1970.
    """

    sha256: str
    size_bytes: int
    used_s: float


class BlobStore:
    """Blobs below one folder, at `ab/cd/<hex>`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        make_folder(folder)

    def recover(self) -> None:
        """Put back what a crash left between the two looks of `discard`; nobody else is at work."""
        for aside in self._folder.glob("[0-9a-f]" * 64 + ".part"):
            _put_back(aside, self.path(aside.stem))
            aside.unlink()

    def path(self, sha256: str) -> Path:
        """Where a blob is, or would be."""
        return self._folder / sha256[:2] / sha256[2:4] / sha256

    def require(self, sha256: str) -> None:
        """Raise `NotFoundError` unless the blob is there."""
        if not self.path(sha256).exists():
            raise NotFoundError("blob", "an uploaded one", sha256)

    def put(self, data: bytes) -> str:
        """Store bytes durably; the digest that names them."""
        temporary = self._folder / f"{uuid.uuid4().hex}.part"
        try:
            temporary.write_bytes(data)
            failpoint("blob.written")
            return self.adopt(temporary)
        finally:
            temporary.unlink(missing_ok=True)

    def adopt(self, source: Path, expected_sha256: str | None = None) -> str:
        """Store a file of the same file system durably; its own name stays for the caller.

        Raises:
            CorruptionError: the file has another digest than expected; nothing is stored.
        """
        with source.open("rb") as file:
            sha256 = hashlib.file_digest(file, "sha256").hexdigest()
        if expected_sha256 not in (None, sha256):
            raise CorruptionError("blob", f"bytes of digest {expected_sha256}", sha256)
        target = self.path(sha256)
        if not _renewed(target):
            sync_file(source)
            failpoint("blob.synced")
            make_folder(target.parent)
            # A link appears whole or not at all, as a rename does, and survives a retry.
            os.link(source, target)
            os.utime(target)
            failpoint("blob.linked")
            sync_folder(target.parent)
        return sha256

    def read(self, sha256: str) -> bytes:
        """The bytes of a blob.

        Raises:
            CorruptionError: the file is gone, or is no longer what its name says.
        """
        path = self.path(sha256)
        data = path.read_bytes() if path.exists() else b""
        _check_digest(sha256, hashlib.sha256(data).hexdigest())
        return data

    def checked_path(self, sha256: str) -> Path:
        """Where a blob lies that is what its name says; raises as `read`."""
        _check_digest(sha256, self.found_digest(sha256) or "no file")
        return self.path(sha256)

    def stored(self) -> Iterator[StoredBlob]:
        """All blobs, whoever names them."""
        for path in self._folder.glob("??/??/*"):
            with contextlib.suppress(FileNotFoundError):
                status = path.stat()
                yield StoredBlob(
                    sha256=path.name, size_bytes=status.st_size, used_s=status.st_mtime
                )

    def found_digest(self, sha256: str) -> str | None:
        """Digest of the bytes that are there under a name, read anew; None if there are none."""
        try:
            with self.path(sha256).open("rb") as file:
                return hashlib.file_digest(file, "sha256").hexdigest()
        except FileNotFoundError:
            return None

    def discard(self, sha256: str, unused_since_s: float) -> bool:
        """Delete a blob, unless somebody has put it again since a time; whether it is gone."""
        path, aside = self.path(sha256), self._folder / f"{sha256}.part"
        try:
            path.rename(aside)
        except FileNotFoundError:
            return False
        # From here on `put` writes it anew. It may have renewed it just before.
        is_old = aside.stat().st_mtime < unused_since_s
        if not is_old:
            _put_back(aside, path)
        aside.unlink()
        return is_old

    def discard_parts(self, unused_since_s: float) -> None:
        """Delete what interrupted writes left."""
        for path in self._folder.glob("*.part"):
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_mtime < unused_since_s:
                    path.unlink()


def _check_digest(sha256: str, found: str) -> None:
    if found != sha256:
        raise CorruptionError(f"blob {sha256}", "bytes of that digest", found)


def _renewed(path: Path) -> bool:
    """Whether a file is there, and then newly used: no sweep under way takes it."""
    try:
        os.utime(path)
    except FileNotFoundError:
        return False
    return True


def _put_back(aside: Path, path: Path) -> None:
    with contextlib.suppress(FileExistsError):
        os.link(aside, path)
