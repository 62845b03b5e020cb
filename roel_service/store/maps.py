"""Maps and their versions; versions come to be in `builds`."""

from __future__ import annotations

from sqlalchemy import Connection, delete, exists, func, insert, select

from roel_service.errors import ConflictError, NotFoundError, StateError
from roel_service.store.blobs import BlobStore
from roel_service.store.database import Database
from roel_service.store.records import (
    UNFINISHED,
    MapRecord,
    MapVersionRecord,
    VersionState,
    map_from_row,
    map_version_from_row,
    now_us,
    row_from_record,
)
from roel_service.store.references import delete_unreferenced
from roel_service.store.schema import MAP, MAP_VERSION, OPERATION


class Maps:
    """Repository of maps. Every method that changes something is durable on return."""

    def __init__(self, database: Database, blobs: BlobStore) -> None:
        self._database = database
        self._blobs = blobs

    def create(self, map_id: str) -> MapRecord:
        """Name a map; raises `ConflictError` ALREADY_EXISTS."""
        record = MapRecord(id=map_id, version_count=0, create_time_us=now_us())
        with self._database.write() as connection:
            if connection.execute(select(exists().where(MAP.c.id == map_id))).scalar_one():
                raise ConflictError("map", "an id not in use", map_id, reason="ALREADY_EXISTS")
            connection.execute(insert(MAP), row_from_record(record))
        return record

    def get(self, map_id: str) -> MapRecord:
        """One map; raises `NotFoundError`."""
        with self._database.read() as connection:
            return get_map(connection, map_id)

    def page(self, after_id: str, limit: int) -> list[MapRecord]:
        """Maps with an id above `after_id`, in the order of ids."""
        query = select(MAP).where(MAP.c.id > after_id).order_by(MAP.c.id).limit(limit)
        with self._database.read() as connection:
            return [map_from_row(row) for row in connection.execute(query).mappings()]

    def delete(self, map_id: str) -> None:
        """Forget a map with its versions; raises `StateError` MAP_IN_USE during a build."""
        with self._database.write() as connection:
            get_map(connection, map_id)
            if _is_in_use(connection, map_id):
                raise StateError(map_id, "no build", "one at work", reason="MAP_IN_USE")
            of_map = select(MAP_VERSION.c.sha256).where(MAP_VERSION.c.map_id == map_id)
            digests = set(connection.scalars(of_map))
            connection.execute(delete(OPERATION).where(OPERATION.c.map_id == map_id))
            connection.execute(delete(MAP).where(MAP.c.id == map_id))
        delete_unreferenced(self._database, self._blobs, digests)

    def version(self, map_id: str, version: int | None) -> MapVersionRecord:
        """One version, by default the newest ACTIVE one; raises `NotFoundError`."""
        with self._database.read() as connection:
            number = version or _latest_version(connection, map_id)
            query = select(MAP_VERSION).where(
                MAP_VERSION.c.map_id == map_id, MAP_VERSION.c.version == number
            )
            row = connection.execute(query).mappings().one_or_none()
        if row is None:
            raise NotFoundError("map version", "an existing one", f"{map_id} v{number}")
        return map_version_from_row(row)

    def version_page(self, map_id: str, after_version: int, limit: int) -> list[MapVersionRecord]:
        """Versions above `after_version`, oldest first; raises `NotFoundError`."""
        query = select(MAP_VERSION).where(
            MAP_VERSION.c.map_id == map_id, MAP_VERSION.c.version > after_version
        )
        with self._database.read() as connection:
            get_map(connection, map_id)
            rows = connection.execute(query.order_by(MAP_VERSION.c.version).limit(limit))
            return [map_version_from_row(row) for row in rows.mappings()]

    def map_file(self, record: MapVersionRecord) -> bytes:
        """The map file of a usable version; raises `StateError` MAP_NOT_ACTIVE."""
        if not record.state.is_usable:
            subject = f"{record.map_id} v{record.version}"
            found = record.state.value
            raise StateError(subject, "a usable version", found, reason="MAP_NOT_ACTIVE")
        return self._blobs.read(record.sha256)


def get_map(connection: Connection, map_id: str) -> MapRecord:
    """One map; raises `NotFoundError`."""
    row = connection.execute(select(MAP).where(MAP.c.id == map_id)).mappings().one_or_none()
    if row is None:
        raise NotFoundError("map", "an existing one", map_id)
    return map_from_row(row)


def _latest_version(connection: Connection, map_id: str) -> int:
    query = select(func.max(MAP_VERSION.c.version)).where(
        MAP_VERSION.c.map_id == map_id, MAP_VERSION.c.state == VersionState.ACTIVE.value
    )
    number = connection.execute(query).scalar_one()
    if number is None:
        raise NotFoundError("map version", f"an active version of {map_id}", "none")
    return int(number)


def _is_in_use(connection: Connection, map_id: str) -> bool:
    unfinished = OPERATION.c.state.in_([state.value for state in UNFINISHED])
    query = select(exists().where(OPERATION.c.map_id == map_id, unfinished))
    return bool(connection.execute(query).scalar_one())
