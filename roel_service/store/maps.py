"""Maps, their aliases and their versions; versions come to be in `builds`."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from sqlalchemy import Connection, bindparam, delete, select

from roel_service.errors import LimitError, NotFoundError, StateError
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.etags import check_etag
from roel_service.store.map_rows import (
    LATEST,
    MAPS,
    change_map,
    change_version,
    check_state,
    check_unused,
    delete_alias,
    find_map,
    forget_map,
    get_current_map,
    get_map,
    get_version,
    insert_map,
    map_records,
    set_alias,
)
from roel_service.store.records import (
    USABLE,
    MapRecord,
    MapVersionRecord,
    OperationRecord,
    VersionState,
    map_version_from_row,
    now_us,
)
from roel_service.store.requests import Memory, RequestId, once, row_memory
from roel_service.store.retention import DAY_US, DELETED_MAP_RETENTION_DAYS
from roel_service.store.schema import MAP, MAP_VERSION

_MAP_MEMORY: Memory[MapRecord] = Memory(
    lambda record: json.dumps(record._asdict()),
    lambda text: MapRecord(**json.loads(text)),
)
_PAGE = MAPS.where(MAP.c.id > bindparam("after_id")).order_by(MAP.c.id).limit(bindparam("limit"))
_VERSION_MEMORY = row_memory(map_version_from_row)


class Maps:
    """Repository of maps. Every method that changes something is durable on return.

    Methods that change something take the request id that the caller gave, or None, and where it
    is named the etag that the map must have, or an empty one.
    """

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    def create(
        self,
        map_id: str,
        *,
        display_name: str = "",
        labels: dict[str, str] | None = None,
        request: RequestId | None = None,
    ) -> MapRecord:
        """Name a map; raises `ConflictError` ALREADY_EXISTS."""
        now = now_us()
        record = MapRecord(
            id=map_id,
            uid=uuid.uuid4().hex,
            version_count=0,
            display_name=display_name,
            labels=labels or {},
            aliases={},
            revision=1,
            create_time_us=now,
            update_time_us=now,
            delete_time_us=0,
            purge_time_us=0,
        )
        return self._changed(request, partial(insert_map, record=record))

    def get(self, map_id: str) -> MapRecord:
        """One map, also a deleted one; raises `NotFoundError`."""
        with self._database.read() as connection:
            return find_map(connection, map_id)

    def page(self, after_id: str, limit: int, *, show_deleted: bool = False) -> list[MapRecord]:
        """Maps with an id above `after_id`, in the order of ids."""
        query = _PAGE if show_deleted else _PAGE.where(MAP.c.delete_time_us == 0)
        with self._database.read() as connection:
            return map_records(connection, query, {"after_id": after_id, "limit": limit})

    def update(
        self, map_id: str, values: dict[str, Any], etag: str, request: RequestId | None
    ) -> MapRecord:
        """Change fields of a map.

        Raises:
            StateError: MAP_DELETED.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            return change_map(connection, get_current_map(connection, map_id, etag), values)

        return self._changed(request, act)

    def delete(self, map_id: str, etag: str, request: RequestId | None) -> MapRecord:
        """Delete a map, so that it can be undeleted for some time.

        Raises:
            StateError: MAP_DELETED, or MAP_IN_USE while a version is being made.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            record = get_current_map(connection, map_id, etag)
            check_unused(connection, map_id)
            now = now_us()
            purge_time_us = now + DELETED_MAP_RETENTION_DAYS * DAY_US
            times = {"delete_time_us": now, "purge_time_us": purge_time_us}
            return change_map(connection, record, times)

        return self._changed(request, act)

    def undelete(self, map_id: str, etag: str, request: RequestId | None) -> MapRecord:
        """Take a deletion back.

        Raises:
            StateError: MAP_NOT_DELETED.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            record = find_map(connection, map_id)
            if not record.is_deleted:
                reason = "MAP_NOT_DELETED"
                raise StateError(map_id, "a deleted map", "one that is not", reason=reason)
            check_etag(record.etag, etag)
            return change_map(connection, record, {"delete_time_us": 0, "purge_time_us": 0})

        return self._changed(request, act)

    def purge(self, map_id: str, etag: str, request: RequestId | None) -> MapRecord:
        """Forget a map for good, as it was last.

        Raises:
            StateError: MAP_IN_USE while a version is being made.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            record = find_map(connection, map_id)
            check_etag(record.etag, etag)
            check_unused(connection, map_id)
            forget_map(connection, map_id)
            return record

        return self._changed(request, act)

    def promote(
        self,
        map_id: str,
        label: int | str,
        alias: str,
        max_alias_count: int,
        *,
        etag: str = "",
        request: RequestId | None = None,
    ) -> MapRecord:
        """Let an alias name a version.

        Raises:
            StateError: MAP_DELETED, or MAP_NOT_ACTIVE for a version that is not complete.
            LimitError: TOO_MANY_ALIASES.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            record = get_current_map(connection, map_id, etag)
            version = get_version(connection, record, label)
            check_state(version, (VersionState.ACTIVE,))
            chosen = {name for name in record.aliases if name != LATEST}
            if alias not in chosen and len(chosen) >= max_alias_count:
                expected = f"at most {max_alias_count} aliases of a map"
                found = f"{len(chosen) + 1}"
                raise LimitError(map_id, expected, found, reason="TOO_MANY_ALIASES")
            set_alias(connection, map_id, alias, version.version)
            change_map(connection, record, {})
            return find_map(connection, map_id)

        return self._changed(request, act)

    def remove_alias(
        self, map_id: str, alias: str, *, etag: str = "", request: RequestId | None = None
    ) -> MapRecord:
        """Let an alias name nothing.

        Raises:
            NotFoundError: no such alias.
            StateError: MAP_DELETED.
            ConflictError: ETAG_MISMATCH.
        """

        def act(connection: Connection) -> MapRecord:
            record = get_current_map(connection, map_id, etag)
            if alias not in record.aliases:
                raise NotFoundError("alias", "an existing one", alias)
            delete_alias(connection, map_id, alias)
            change_map(connection, record, {})
            return find_map(connection, map_id)

        return self._changed(request, act)

    def version(self, map_id: str, label: int | str) -> MapVersionRecord:
        """One version by its number or an alias; raises `NotFoundError`, `StateError` MAP_DELETED."""
        with self._database.read() as connection:
            return get_version(connection, get_map(connection, map_id), label)

    def made_version(self, operation: OperationRecord) -> MapVersionRecord:
        """What an operation makes or made, also of a deleted map; raises `NotFoundError`."""
        with self._database.read() as connection:
            record = find_map(connection, operation.map_id)
            return get_version(connection, record, operation.version)

    def version_page(self, map_id: str, after_version: int, limit: int) -> list[MapVersionRecord]:
        """Versions above `after_version`, oldest first; raises as `version`."""
        query = select(MAP_VERSION).where(
            MAP_VERSION.c.map_id == map_id, MAP_VERSION.c.version > after_version
        )
        with self._database.read() as connection:
            get_map(connection, map_id)
            rows = connection.execute(query.order_by(MAP_VERSION.c.version).limit(limit))
            return [map_version_from_row(row) for row in rows.mappings()]

    def delete_version(
        self, map_id: str, number: int, request: RequestId | None
    ) -> MapVersionRecord:
        """Delete a version.

        Raises:
            StateError: MAP_DELETED; MAP_IN_USE while it is being made; VERSION_HAS_ALIAS;
                MAP_NOT_ACTIVE when it is deleted already.
        """

        def act(connection: Connection) -> MapVersionRecord:
            record = get_map(connection, map_id)
            version = get_version(connection, record, number)
            check_state(version, (*USABLE, VersionState.CREATING, VersionState.FAILED))
            check_unused(connection, map_id, version.version)
            aliases = {name for name in record.aliases if record.aliases[name] == version.version}
            if aliases - {LATEST}:
                subject = f"{map_id} v{version.version}"
                found = ", ".join(sorted(aliases - {LATEST}))
                reason = "VERSION_HAS_ALIAS"
                raise StateError(subject, "a version without alias", found, reason=reason)
            purge_time_us = now_us() + DELETED_MAP_RETENTION_DAYS * DAY_US
            changes = {
                "state": VersionState.DELETED,
                "deleted_state": version.state.value,
                "purge_time_us": purge_time_us,
            }
            return change_version(connection, version, changes)

        return self._changed_version(request, act)

    def undelete_version(
        self, map_id: str, number: int, request: RequestId | None
    ) -> MapVersionRecord:
        """Take the deletion of a version back.

        Raises:
            StateError: MAP_DELETED; MAP_NOT_DELETED for a version that is not.
        """

        def act(connection: Connection) -> MapVersionRecord:
            version = get_version(connection, get_map(connection, map_id), number)
            if not version.deleted_state:
                subject = f"{map_id} v{version.version}"
                reason = "MAP_NOT_DELETED"
                raise StateError(subject, "a deleted version", version.state.value, reason=reason)
            state = VersionState(version.deleted_state)
            changes = {"state": state, "deleted_state": "", "purge_time_us": 0}
            return change_version(connection, version, changes)

        return self._changed_version(request, act)

    def map_file(self, record: MapVersionRecord) -> bytes:
        """The map file of a usable version; raises `StateError` MAP_NOT_ACTIVE."""
        check_state(record, USABLE)
        return self._blobs.read(record.sha256)

    def map_path(self, record: MapVersionRecord) -> Path:
        """Where the map file of a usable version lies; raises as `map_file`."""
        check_state(record, USABLE)
        return self._blobs.checked_path(record.sha256)

    def imported_path(self, record: MapVersionRecord) -> Path:
        """Where the file lies that a version is being made from."""
        return self._blobs.path(record.imported_file["sha256"])

    def forget_deleted(self) -> None:
        """Forget maps and versions whose time has come; their blobs are left to the sweep."""
        now = now_us()
        with self._database.write() as connection:
            gone = select(MAP.c.id).where(MAP.c.purge_time_us.between(1, now))
            for map_id in connection.scalars(gone).all():
                forget_map(connection, map_id)
            versions = MAP_VERSION.c.purge_time_us.between(1, now)
            connection.execute(delete(MAP_VERSION).where(versions))

    def _changed_version(
        self, request: RequestId | None, act: Callable[[Connection], MapVersionRecord]
    ) -> MapVersionRecord:
        with self._database.write() as connection:
            return once(connection, request, _VERSION_MEMORY, partial(act, connection))

    def _changed(
        self, request: RequestId | None, act: Callable[[Connection], MapRecord]
    ) -> MapRecord:
        with self._database.write() as connection:
            return once(connection, request, _MAP_MEMORY, partial(act, connection))
