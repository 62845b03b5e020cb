"""Who calls, and whether they may: decided before anything of the request is looked at."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from urllib.parse import unquote

from roel_service.errors import PermissionDeniedError, UnauthenticatedError
from roel_service.service.calls import Call
from roel_service.service.rules import rule_of
from roel_service.store.principals import Principal, Principals, Role

BEARER = "Bearer "

# Whoever sits at the machine, as long as nobody has been named, and whoever embeds the server.
LOCAL_ADMIN = Principal(name="local", role=Role.ADMIN)


class Access:
    """Finds out who calls by token or certificate, and holds the role against the method's rule.

    An answer never tells whether what the request names exists: nothing is looked up before this.
    """

    def __init__(self, principals: Principals) -> None:
        self._principals = principals

    @asynccontextmanager
    async def __call__(self, call: Call) -> AsyncIterator[None]:
        """Guard one call; raises `UnauthenticatedError` or `PermissionDeniedError`."""
        call.principal = await asyncio.to_thread(self._caller, call)
        needed = rule_of(call.method).role
        if call.principal.role < needed:
            expected, found = f"a caller with the role {needed.label}", call.principal.role.label
            raise PermissionDeniedError(call.method, expected, found)
        yield

    def _caller(self, call: Call) -> Principal:
        if call.authorization is not None:
            return _known(self._of_token(call.authorization), "a token that is not known")
        names = call.certificate_names
        if names:
            return _known(self._principals.of_names(names), "a certificate of nobody known")
        # Whoever can open a socket file can open the data folder too.
        if is_socket_peer(call.peer) or (is_local_peer(call.peer) and self._principals.is_empty()):
            return LOCAL_ADMIN
        raise UnauthenticatedError("caller", "a token or a certificate", "neither")

    def _of_token(self, authorization: str) -> Principal | None:
        if not authorization.startswith(BEARER):
            return None
        return self._principals.of_token(authorization.removeprefix(BEARER))


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
