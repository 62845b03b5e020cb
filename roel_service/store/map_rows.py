"""Rows of maps and their versions, within a transaction of the caller."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Sequence
from typing import Any

from sqlalchemy import (
    Connection,
    Select,
    bindparam,
    delete,
    exists,
    func,
    insert,
    select,
    update,
)

from roel_service.errors import ConflictError, NotFoundError, StateError
from roel_service.store.etags import check_etag
from roel_service.store.records import (
    UNFINISHED,
    USABLE,
    MapRecord,
    MapVersionRecord,
    VersionState,
    map_version_from_row,
    now_us,
    stored,
)
from roel_service.store.schema import MAP, MAP_ALIAS, MAP_VERSION, OPERATION

# The alias that nobody sets: the newest usable version.
LATEST = "latest"

_NEWEST = select(func.max(MAP_VERSION.c.version)).where(
    MAP_VERSION.c.map_id == MAP.c.id,
    MAP_VERSION.c.state.in_([state.value for state in USABLE]),
)
_ALIASES = select(func.json_group_object(MAP_ALIAS.c.alias, MAP_ALIAS.c.version)).where(
    MAP_ALIAS.c.map_id == MAP.c.id
)

# Maps as `map_records` reads them: the columns that a record has as they are come first.
MAPS = select(
    *(MAP.c[name] for name in MapRecord._fields if name not in ("labels", "aliases")),
    _NEWEST.scalar_subquery().label("newest"),
    MAP.c.labels,
    _ALIASES.scalar_subquery().label("aliases"),
)
_ONE_MAP = MAPS.where(MAP.c.id == bindparam("map_id"))


def get_map(connection: Connection, map_id: str) -> MapRecord:
    """One map that lives; raises `NotFoundError`, or `StateError` MAP_DELETED."""
    record = find_map(connection, map_id)
    if record.is_deleted:
        expected = "a map that is not deleted"
        raise StateError(map_id, expected, "one that is", reason="MAP_DELETED")
    return record


def find_map(connection: Connection, map_id: str) -> MapRecord:
    """One map, also a deleted one; raises `NotFoundError`."""
    records = map_records(connection, _ONE_MAP, {"map_id": map_id})
    if not records:
        raise NotFoundError("map", "an existing one", map_id)
    return records[0]


def map_records(
    connection: Connection, query: Select[Any], arguments: dict[str, Any]
) -> list[MapRecord]:
    """The maps that a query of `MAPS` finds."""
    rows = connection.execute(query, arguments).all()
    # All texts at once: one by one they would take as long as all the rest.
    texts = ",".join(text for row in rows for text in (row.labels, row.aliases))
    parsed = iter(json.loads(f"[{texts}]"))
    return [
        MapRecord._make((*columns, next(parsed), _with_latest(next(parsed), newest)))
        for *columns, newest, _, _ in rows
    ]


def _with_latest(aliases: dict[str, int], newest: int | None) -> dict[str, int]:
    return aliases if newest is None else {**aliases, LATEST: newest}


def get_version(connection: Connection, record: MapRecord, label: int | str) -> MapVersionRecord:
    """One version by its number or an alias; raises `NotFoundError`."""
    number = label if isinstance(label, int) else record.aliases.get(label, 0)
    query = select(MAP_VERSION).where(
        MAP_VERSION.c.map_id == record.id, MAP_VERSION.c.version == number
    )
    row = connection.execute(query).mappings().one_or_none()
    if row is None:
        shown = f"v{label}" if isinstance(label, int) else label
        raise NotFoundError("map version", "an existing one", f"{record.id} {shown}")
    return map_version_from_row(row)


def insert_map(connection: Connection, record: MapRecord) -> MapRecord:
    """A new map; raises `ConflictError` ALREADY_EXISTS."""
    if connection.execute(select(exists().where(MAP.c.id == record.id))).scalar_one():
        raise ConflictError("map", "an id not in use", record.id, reason="ALREADY_EXISTS")
    row = record._asdict()
    del row["aliases"]
    connection.execute(insert(MAP), stored(row))
    return record


def change_map(connection: Connection, record: MapRecord, values: dict[str, Any]) -> MapRecord:
    """Change fields on a caller's behalf: the map gets a new etag."""
    changes = {**values, "revision": record.revision + 1, "update_time_us": now_us()}
    connection.execute(update(MAP).where(MAP.c.id == record.id).values(stored(changes)))
    return record._replace(**changes)


def forget_map(connection: Connection, map_id: str) -> None:
    """Delete a map with its versions, aliases and operations."""
    connection.execute(delete(OPERATION).where(OPERATION.c.map_id == map_id))
    connection.execute(delete(MAP).where(MAP.c.id == map_id))


def get_current_map(connection: Connection, map_id: str, etag: str) -> MapRecord:
    """One map that lives and has the etag; raises as `get_map` and `check_etag`."""
    record = get_map(connection, map_id)
    check_etag(record.etag, etag)
    return record


def check_state(version: MapVersionRecord, wanted: Sequence[VersionState]) -> None:
    """Raise `StateError` MAP_NOT_ACTIVE for a version in another state."""
    if version.state not in wanted:
        subject = f"{version.map_id} v{version.version}"
        expected = "a usable version"
        raise StateError(subject, expected, version.state.value, reason="MAP_NOT_ACTIVE")


def check_unused(connection: Connection, map_id: str, version: int | None = None) -> None:
    """Raise `StateError` MAP_IN_USE while a version of the map, or just this one, is being made."""
    unfinished = OPERATION.c.state.in_([state.value for state in UNFINISHED])
    of_map = (OPERATION.c.map_id == map_id) & unfinished
    if version is not None:
        of_map &= OPERATION.c.version == version
    if connection.execute(select(exists().where(of_map))).scalar_one():
        raise StateError(map_id, "no version being made", "one", reason="MAP_IN_USE")


def set_alias(connection: Connection, map_id: str, alias: str, version: int) -> None:
    """Let an alias name a version, whatever it named before."""
    delete_alias(connection, map_id, alias)
    row = {"map_id": map_id, "alias": alias, "version": version}
    connection.execute(insert(MAP_ALIAS), row)


def delete_alias(connection: Connection, map_id: str, alias: str) -> None:
    """Let an alias name nothing; one that names nothing is fine."""
    key = (MAP_ALIAS.c.map_id == map_id) & (MAP_ALIAS.c.alias == alias)
    connection.execute(delete(MAP_ALIAS).where(key))


def change_version(
    connection: Connection, version: MapVersionRecord, changes: dict[str, Any]
) -> MapVersionRecord:
    """Change fields of a version."""
    key = (MAP_VERSION.c.map_id == version.map_id) & (MAP_VERSION.c.version == version.version)
    connection.execute(update(MAP_VERSION).where(key).values(stored(changes)))
    return dataclasses.replace(version, **changes)
