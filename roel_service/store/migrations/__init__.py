"""Numbered steps from one version of a data folder to the next; they only lead forward.

A released step is never changed, and none imports the tables of `schema`: those say how rows look now.
"""

from __future__ import annotations

from collections.abc import Callable

from sqlalchemy import Connection, text

from roel_service.errors import StateError
from roel_service.store.migrations import (
    m001_first_tables,
    m002_methods_of_operations,
    m003_tasks,
    m004_maps_and_requests,
    m005_writers_of_recordings,
    m006_uploads,
    m007_principals,
    m008_results,
    m009_undeleted_versions,
    m010_owners,
    m011_labels_of_recordings,
)

# Step k leads from version k to k + 1.
MIGRATIONS: tuple[Callable[[Connection], None], ...] = (
    m001_first_tables.migrate,
    m002_methods_of_operations.migrate,
    m003_tasks.migrate,
    m004_maps_and_requests.migrate,
    m005_writers_of_recordings.migrate,
    m006_uploads.migrate,
    m007_principals.migrate,
    m008_results.migrate,
    m009_undeleted_versions.migrate,
    m010_owners.migrate,
    m011_labels_of_recordings.migrate,
)


def is_current(connection: Connection) -> bool:
    """Whether nothing is to be done."""
    version = connection.execute(text("PRAGMA user_version")).scalar_one()
    return bool(version == len(MIGRATIONS))


def migrate(connection: Connection) -> None:
    """Bring the tables to the newest version.

    Raises:
        StateError: DATA_TOO_NEW, the folder was written by a newer release.
    """
    version = _version(connection)
    for step in MIGRATIONS[version:]:
        step(connection)
    connection.execute(text(f"PRAGMA user_version = {len(MIGRATIONS)}"))


def check_version(connection: Connection) -> None:
    """Raise `StateError` DATA_TOO_NEW or DATA_TOO_OLD unless the tables are the newest."""
    version = _version(connection)
    if version < len(MIGRATIONS):
        expected = f"a data folder of version {len(MIGRATIONS)}, which its next start makes it"
        raise StateError("data folder", expected, f"version {version}", reason="DATA_TOO_OLD")


def _version(connection: Connection) -> int:
    version = int(connection.execute(text("PRAGMA user_version")).scalar_one())
    if version > len(MIGRATIONS):
        expected = f"a data folder of version {len(MIGRATIONS)} or older"
        raise StateError("data folder", expected, f"version {version}", reason="DATA_TOO_NEW")
    return version
