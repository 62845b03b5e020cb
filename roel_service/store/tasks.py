"""Tasks: who works on what, and until when that is believed.

A lease has a number, the fence. Whoever ends an attempt names it, and is refused when somebody else
took the task meanwhile: of two attempts at most one counts.
"""

from __future__ import annotations

import uuid
from typing import Any

from sqlalchemy import Connection, insert, or_, select, update

from roel_service.errors import ConflictError
from roel_service.failpoints import failpoint
from roel_service.store.database import Database
from roel_service.store.records import (
    Lease,
    TaskRecord,
    TaskState,
    now_us,
    row_from_record,
    stored,
    task_from_row,
)
from roel_service.store.schema import TASK

LEASE_US = 30_000_000

_READY = TASK.c.state == TaskState.READY.value
_LEASED = TASK.c.state == TaskState.LEASED.value


class Tasks:
    """Repository of tasks. Every method that changes something is durable on return."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def lease(self, owner: str) -> TaskRecord | None:
        """Take the task that has waited longest; None when nothing is to be done now.

        A task whose lease has run out is one that somebody left behind.
        """
        now = now_us()
        may_begin = or_(_READY & (TASK.c.not_before_us <= now), _LEASED & _has_run_out(now))
        query = select(TASK).where(may_begin).order_by(TASK.c.not_before_us).limit(1)
        with self._database.write() as connection:
            row = connection.execute(query).mappings().one_or_none()
            if row is None:
                return None
            changes = {
                "state": TaskState.LEASED,
                "attempt_count": row["attempt_count"] + 1,
                "lease_owner": owner,
                "lease_until_us": now + LEASE_US,
                "fence": row["fence"] + 1,
            }
            _change(connection, row["id"], changes)
        failpoint("task.leased")
        return task_from_row({**row, **stored(changes)})  # type: ignore[arg-type]

    def renew(self, owner: str) -> set[str]:
        """Hold on to all tasks of an owner; their ids."""
        held = _LEASED & (TASK.c.lease_owner == owner)
        with self._database.write() as connection:
            until = {"lease_until_us": now_us() + LEASE_US}
            connection.execute(update(TASK).where(held).values(until))
            return set(connection.scalars(select(TASK.c.id).where(held)))

    def expire_leases(self) -> None:
        """Believe in no lease; for a server that begins, since all who held one are gone."""
        with self._database.write() as connection:
            connection.execute(update(TASK).where(_LEASED).values(lease_until_us=0))


def insert_task(
    connection: Connection, operation_id: str, parameters: bytes, inputs: list[str]
) -> None:
    """The work of a new operation, which may begin at once."""
    task = TaskRecord(
        id=uuid.uuid4().hex,
        operation_id=operation_id,
        state=TaskState.READY,
        parameters=parameters,
        inputs=inputs,
        attempt_count=0,
        memory_doublings=0,
        failure_hash="",
        not_before_us=now_us(),
        lease_owner="",
        lease_until_us=0,
        fence=0,
    )
    connection.execute(insert(TASK), row_from_record(task))


def check_lease(connection: Connection, lease: Lease) -> None:
    """Raise `ConflictError` LEASE_LOST unless the lease is the newest of its task."""
    query = select(TASK.c.fence).where(TASK.c.id == lease.task_id, _LEASED)
    fence = connection.execute(query).scalar_one_or_none()
    if fence != lease.fence:
        found = "a task that has ended" if fence is None else f"{fence}"
        raise ConflictError("task", f"fence {lease.fence}", found, reason="LEASE_LOST")


def end_task(connection: Connection, lease: Lease, state: TaskState) -> None:
    """The attempt was the last one."""
    _change(connection, lease.task_id, {"state": state})


def requeue_task(connection: Connection, lease: Lease, changes: dict[str, Any]) -> None:
    """Let the task be taken again."""
    _change(connection, lease.task_id, {"state": TaskState.READY, **changes})


def end_tasks_of(connection: Connection, operation_id: str) -> None:
    """Nothing of an operation is to be done any more, and no attempt at it counts."""
    unfinished = (TASK.c.operation_id == operation_id) & or_(_READY, _LEASED)
    failed = {"state": TaskState.FAILED.value}
    connection.execute(update(TASK).where(unfinished).values(failed))


def _change(connection: Connection, task_id: str, changes: dict[str, Any]) -> None:
    connection.execute(update(TASK).where(TASK.c.id == task_id).values(stored(changes)))


def _has_run_out(now: int) -> Any:
    return TASK.c.lease_until_us <= now
