"""One data folder: rows, blobs, recordings, uploads, scratch, and the lock on all of them."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from sqlalchemy.exc import SQLAlchemyError

from roel_service.errors import InputError, StateError
from roel_service.store.audit import Audit
from roel_service.store.batches import BatchCompletion, Batches
from roel_service.store.blobs import BlobStore
from roel_service.store.builds import Builds, VersionCompletion
from roel_service.store.database import Database
from roel_service.store.event_imports import EventImportCompletion, EventImports
from roel_service.store.event_streams import EventStreams
from roel_service.store.files import make_folder
from roel_service.store.garbage import LONGEST_UPLOAD_S, Swept, sweep_blobs
from roel_service.store.maps import Maps
from roel_service.store.operations import Operations
from roel_service.store.principals import Principals
from roel_service.store.quotas import Caller, Holdings, holdings_of
from roel_service.store.recordings import Recordings
from roel_service.store.records import OperationMethod
from roel_service.store.refinements import RefinementCompletion, Refinements
from roel_service.store.requests import delete_expired_requests
from roel_service.store.tasks import Tasks
from roel_service.store.uploads import Uploads
from roel_service.store.usage import Usage, usage_of

# A row has some 150 bytes.
AUDIT_ROW_COUNT = 1_000_000


ROWS = "rows.sqlite"
BLOBS = "blobs/sha256"
RECORDINGS = "recordings"
CACHE = "cache"


class Store:
    """What a server remembers; a context manager that holds the folder's lock.

    Attributes:
        folder: where it is.
        event_streams, event_imports, uploads, maps, builds, refinements, batches, operations,
            tasks: the repositories.
        principals, audit: who may call, and who changed what.

    Raises:
        InputError: a folder that cannot be created or written.
        StateError: DATA_IN_USE, another server has the folder; DATA_TOO_NEW.
    """

    def __init__(self, folder: Path) -> None:
        _check_folder(folder)
        self.folder = folder
        with ExitStack() as resources:
            resources.enter_context(_locked(folder))
            self._database = Database(folder / ROWS)
            resources.callback(self._database.close)
            self._database.migrate()
            self._blobs = BlobStore(folder / BLOBS)
            self._recordings = Recordings(folder / RECORDINGS)
            self.event_streams = EventStreams(self._database, self._blobs, self._recordings)
            self.event_imports = EventImports(self._database, self._blobs, self.event_streams)
            self.maps = Maps(self._database, self._blobs)
            self.builds = Builds(self._database, self._blobs)
            self.principals = Principals(self._database)
            self.audit = Audit(self._database, AUDIT_ROW_COUNT)
            self.refinements = Refinements(self._database, self._blobs)
            self.batches = Batches(self._database, self._blobs, folder / "batches")
            versions, batches = VersionCompletion(self._blobs), BatchCompletion(self._blobs)
            self.operations = Operations(
                self._database,
                {
                    OperationMethod.BUILD_MAP: versions,
                    OperationMethod.IMPORT_MAP: versions,
                    OperationMethod.IMPORT_EVENT_STREAM: EventImportCompletion(self._recordings),
                    OperationMethod.REFINE_POSES: RefinementCompletion(self._blobs, versions),
                    OperationMethod.BATCH_REGISTER: batches,
                    OperationMethod.BATCH_LOCALIZE: batches,
                },
            )
            self.tasks = Tasks(self._database)
            self.uploads = Uploads(self._database, self._blobs, folder / "uploads")
            # What a crash left of uploads; nothing is being written yet.
            self.event_streams.recover()
            self.uploads.recover()
            self.batches.delete_ended()
            self._scratch = _emptied(folder / "scratch")
            self._blobs.recover()
            self._resources = resources.pop_all()

    def __enter__(self) -> Store:
        return self

    def __exit__(self, *error: object) -> None:
        self._resources.close()

    def collect_garbage(self, unused_for_s: float = LONGEST_UPLOAD_S) -> Swept:
        """Forget what has expired, then delete the blobs that no row names."""
        self.operations.delete_expired()
        self.maps.forget_deleted()
        self.uploads.delete_expired()
        self.batches.delete_ended()
        with self._database.write() as connection:
            delete_expired_requests(connection)
        return sweep_blobs(self._database, self._blobs, unused_for_s)

    def usage(self) -> Usage:
        """How much the folder holds, and how much is going on."""
        return usage_of(self._database)

    def holdings(self, caller: Caller) -> Holdings:
        """What a caller has."""
        return holdings_of(self._database, caller)

    def problems(self) -> list[str]:
        """What keeps the store from working, a sentence each."""
        problems = []
        try:
            self.principals.is_empty()
        except SQLAlchemyError as error:
            problems.append(f"the database cannot be read: {type(error).__name__}")
        if not os.access(self.folder, os.W_OK | os.X_OK):
            problems.append("the data folder cannot be written")
        return problems

    def scratch_file(self, name: str) -> Path:
        """Where work may leave a file of this name; gone at the next start."""
        return self._scratch / name

    @contextmanager
    def scratch(self) -> Iterator[Path]:
        """A folder for files that only a call needs; gone with the block."""
        with TemporaryDirectory(dir=self._scratch) as name:
            yield Path(name)


@contextmanager
def opened_principals(folder: Path) -> Iterator[Principals]:
    """The principals of a folder that a server may be using at the same time.

    Raises:
        InputError: a folder that cannot be created or written.
        StateError: DATA_IN_USE, a server of an older release has the folder; DATA_TOO_NEW.
    """
    _check_folder(folder)
    database = Database(folder / ROWS)
    try:
        if not database.is_current():
            with _locked(folder):
                database.migrate()
        yield Principals(database)
    finally:
        database.close()


@contextmanager
def recordings_of(folder: Path) -> Iterator[EventStreams]:
    """The recordings of a folder that a server has open; to be read, not to be changed."""
    database = Database(folder / ROWS)
    try:
        blobs = BlobStore(folder / BLOBS)
        yield EventStreams(database, blobs, Recordings(folder / RECORDINGS))
    finally:
        database.close()


@contextmanager
def maps_of(folder: Path) -> Iterator[tuple[Maps, BlobStore]]:
    """The maps and blobs of a folder that a server has open; to be read, not to be changed."""
    database = Database(folder / ROWS)
    try:
        blobs = BlobStore(folder / BLOBS)
        yield Maps(database, blobs), blobs
    finally:
        database.close()


def _check_folder(folder: Path) -> None:
    """Create the folder if need be; raises `InputError` unless it can be written."""
    try:
        make_folder(folder)
    except OSError as error:
        raise InputError(str(folder), "a data folder", f"{error.strerror}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise InputError(str(folder), "a data folder that can be written", "no permission")


def _emptied(folder: Path) -> Path:
    """An empty folder; what a server that died had left there is gone."""
    shutil.rmtree(folder, ignore_errors=True)
    make_folder(folder)
    return folder


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Hold an advisory lock, which the system releases however the process ends."""
    with (folder / "lock").open("w") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            expected = "a data folder that no other server uses"
            raise StateError(str(folder), expected, "one in use", reason="DATA_IN_USE") from error
        yield
