"""Who may call: names with a role and the digest of a secret token."""

from __future__ import annotations

import hashlib
import re
import secrets
from dataclasses import asdict, dataclass, field
from enum import IntEnum

from sqlalchemy import Row, delete, func, insert, select

from roel_service.errors import ConflictError, InputError, NotFoundError
from roel_service.store.database import Database
from roel_service.store.quotas import Quota
from roel_service.store.records import now_us
from roel_service.store.schema import PRINCIPAL

# A prefix makes a leaked token easy to find; 256 random bits need no slow hash.
TOKEN_PREFIX = "roel_"
TOKEN_BYTES = 32

# Also the names that certificates carry: host names, e-mail addresses, URIs.
NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._:@/-]{0,254}")


NO_LIMITS = Quota()


class Role(IntEnum):
    """What a principal may do; each may do all that those before it may."""

    LOCALIZE_ONLY = 1
    READER = 2
    BUILDER = 3
    ADMIN = 4

    @property
    def label(self) -> str:
        """As people write it."""
        return self.name.lower()


@dataclass(frozen=True, kw_only=True)
class Principal:
    """Somebody who may call.

    Attributes:
        name: shown in logs and in the audit; the name in a client's certificate.
        token_sha256: digest of the token.
        create_time_us: microseconds since 1970.
        expire_time_us: from then on it is nobody; 0 for never.
        quota: what it may have.
    """

    name: str
    role: Role
    token_sha256: str = field(default="", repr=False)
    create_time_us: int = 0
    expire_time_us: int = 0
    quota: Quota = field(default_factory=Quota)

    @property
    def is_current(self) -> bool:
        return self.expire_time_us == 0 or now_us() < self.expire_time_us


class Principals:
    """Repository of principals."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def create(
        self, name: str, role: Role, expire_time_us: int = 0, quota: Quota = NO_LIMITS
    ) -> str:
        """Its token, which nobody can be told again: only a digest is kept.

        Raises:
            InputError: ID_INVALID.
            ConflictError: ALREADY_EXISTS.
        """
        if not NAME.fullmatch(name):
            expected = "letters, digits and . _ : @ / -, at most 255"
            raise InputError("name", expected, repr(name), reason="ID_INVALID")
        token = TOKEN_PREFIX + secrets.token_urlsafe(TOKEN_BYTES)
        with self._database.write() as connection:
            named = select(PRINCIPAL.c.name).where(PRINCIPAL.c.name == name)
            if connection.execute(named).first() is not None:
                expected, found = "a name not in use", "one in use"
                raise ConflictError(name, expected, found, reason="ALREADY_EXISTS")
            row = {
                "name": name,
                "role": role.label,
                "token_sha256": token_sha256(token),
                "create_time_us": now_us(),
                "expire_time_us": expire_time_us,
                **{f"max_{key}": limit for key, limit in asdict(quota).items()},
            }
            connection.execute(insert(PRINCIPAL), row)
        return token

    def revoke(self, name: str) -> None:
        """Make a principal nobody, from its next call on; raises `NotFoundError`."""
        with self._database.write() as connection:
            done = connection.execute(delete(PRINCIPAL).where(PRINCIPAL.c.name == name))
            if done.rowcount == 0:
                raise NotFoundError(name, "a principal", "none of that name")

    def list(self) -> list[Principal]:
        """All of them, by name."""
        with self._database.read() as connection:
            rows = connection.execute(select(PRINCIPAL).order_by(PRINCIPAL.c.name))
            return [_principal(row) for row in rows]

    def is_empty(self) -> bool:
        """Whether nobody has been named yet."""
        with self._database.read() as connection:
            count = connection.execute(select(func.count()).select_from(PRINCIPAL)).scalar_one()
            return bool(count == 0)


def token_sha256(token: str) -> str:
    """What is kept of a token."""
    return hashlib.sha256(token.encode()).hexdigest()


def _principal(row: Row[tuple[object, ...]]) -> Principal:
    return Principal(
        name=row.name,
        role=Role[row.role.upper()],
        token_sha256=row.token_sha256,
        create_time_us=row.create_time_us,
        expire_time_us=row.expire_time_us,
        quota=Quota(**{key: getattr(row, f"max_{key}") for key in asdict(NO_LIMITS)}),
    )
