"""A copy of a data folder that can take its place, also of one that a server has open."""

from __future__ import annotations

import shutil
import sqlite3
from contextlib import closing, suppress
from pathlib import Path

from roel_service.errors import InputError, StateError
from roel_service.store.files import make_folder, sync_file, sync_folder
from roel_service.store.fsck import Findings, check_folder

ROWS = "rows.sqlite"

# Recordings that are frozen, and maps that are deleted, while they are copied.
ATTEMPT_COUNT = 3


def back_up(folder: Path, target: Path) -> Findings:
    """Copy rows, blobs and open recordings; what was found when the copy was checked.

    Rows come first: every file that they name exists by then and is never changed, and an open
    recording only grows.

    Raises:
        InputError: no data folder.
        StateError: BACKUP_OUTDATED, files went away while they were copied.
    """
    if not (folder / ROWS).is_file():
        raise InputError(str(folder), "a data folder", "none")
    for _ in range(ATTEMPT_COUNT):
        _copy_rows(folder / ROWS, target / ROWS)
        for name in ("blobs", "recordings", "uploads"):
            _copy_files(folder / name, target / name)
        findings = check_folder(target)
        if not findings.problems:
            return findings
    expected = "a folder that holds still, or is sound"
    raise StateError(str(folder), expected, findings.problems[0], reason="BACKUP_OUTDATED")


def _copy_rows(source: Path, target: Path) -> None:
    make_folder(target.parent)
    with closing(sqlite3.connect(source)) as rows, closing(sqlite3.connect(target)) as copy:
        rows.backup(copy)
    sync_file(target)
    sync_folder(target.parent)


def _copy_files(source: Path, target: Path) -> None:
    for path in source.rglob("*"):
        if path.suffix == ".part" or not path.is_file():
            continue
        copy = target / path.relative_to(source)
        make_folder(copy.parent)
        # A file that goes away belongs to no row, or to one that the check will miss.
        with suppress(FileNotFoundError):
            shutil.copy2(path, copy)
            sync_file(copy)
