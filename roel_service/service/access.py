"""Who calls, and whether they may: decided before anything of the request is looked at."""

from __future__ import annotations

import asyncio
import ipaddress
import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from urllib.parse import unquote

from roel_service.errors import PermissionDeniedError, UnauthenticatedError
from roel_service.service.calls import Call
from roel_service.service.rules import rule_of
from roel_service.store.principals import Principal, Principals, Role, token_sha256
from roel_service.store.quotas import CALLER, Caller

# A look into the database for each call would double the cost of a lookup.
REREAD_INTERVAL_S = 1.0

BEARER = "Bearer "

# Whoever sits at the machine, as long as nobody has been named, and whoever embeds the server.
LOCAL_ADMIN = Principal(name="local", role=Role.ADMIN)


class Directory:
    """Everybody who may call, at one moment."""

    def __init__(self, principals: list[Principal]) -> None:
        self._of_token = {item.token_sha256: item for item in principals}
        self._of_name = {item.name: item for item in principals}

    @property
    def is_empty(self) -> bool:
        return not self._of_name

    def of_token(self, token: str) -> Principal | None:
        """Who has this token."""
        return _current(self._of_token.get(token_sha256(token)))

    def of_names(self, names: Sequence[str]) -> Principal | None:
        """Who has one of the names that a certificate carries; the first decides."""
        found = (_current(self._of_name.get(name)) for name in names)
        return next((principal for principal in found if principal is not None), None)


class Access:
    """Finds out who calls by token or certificate, and holds the role against the method's rule.

    An answer never tells whether what the request names exists: nothing is looked up before this.
    Changes of principals count after `REREAD_INTERVAL_S`.
    """

    def __init__(self, principals: Principals) -> None:
        self._principals = principals
        self._directory = Directory(principals.list())
        self._read_s = time.monotonic()

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call; raises `UnauthenticatedError` or `PermissionDeniedError`."""
        await self._reread()
        call.principal = self._caller(call)
        needed = rule_of(call.method).role
        if call.principal.role < needed:
            expected, found = f"a caller with the role {needed.label}", call.principal.role.label
            raise PermissionDeniedError(call.method, expected, found)
        # What the call makes is its caller's. A call is a task of its own, and so is its context.
        CALLER.set(Caller(name=call.principal.name, quota=call.principal.quota))
        yield

    async def _reread(self) -> None:
        now_s = time.monotonic()
        if now_s < self._read_s + REREAD_INTERVAL_S:
            return
        # Others go on with what is known while this call reads.
        self._read_s = now_s
        self._directory = Directory(await asyncio.to_thread(self._principals.list))

    def _caller(self, call: Call) -> Principal:
        if call.authorization is not None:
            return _known(self._of_token(call.authorization), "a token that is not known")
        names = call.certificate_names
        if names:
            return _known(self._directory.of_names(names), "a certificate of nobody known")
        # Whoever can open a socket file can open the data folder too.
        if is_socket_peer(call.peer) or (is_local_peer(call.peer) and self._directory.is_empty):
            return LOCAL_ADMIN
        raise UnauthenticatedError("caller", "a token or a certificate", "neither")

    def _of_token(self, authorization: str) -> Principal | None:
        if not authorization.startswith(BEARER):
            return None
        return self._directory.of_token(authorization.removeprefix(BEARER))


def _current(principal: Principal | None) -> Principal | None:
    return principal if principal is not None and principal.is_current else None


def _known(principal: Principal | None, found: str) -> Principal:
    if principal is None:
        raise UnauthenticatedError("caller", "a known caller", found)
    return principal


def is_socket_peer(peer: str) -> bool:
    """Whether gRPC's name of a peer says that it came through a socket file."""
    return peer.startswith("unix:")


def is_local_peer(peer: str) -> bool:
    """Whether gRPC's name of a peer is an address that only this machine has."""
    host = unquote(peer).partition(":")[2].rpartition(":")[0]
    return is_loopback(host.strip("[]"))


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
