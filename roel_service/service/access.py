"""Who calls, and whether they may: decided before anything of the request is looked at."""

from __future__ import annotations

import asyncio
import ipaddress
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any
from urllib.parse import unquote

from roel_service.errors import PermissionDeniedError, UnauthenticatedError
from roel_service.service.calls import Call
from roel_service.service.rules import rule_of
from roel_service.store.principals import Principal, Principals, Role

BEARER = "Bearer "

# What is known of a certificate's owner, the names that a client was given for itself.
CERTIFICATE_NAMES = ("x509_subject_alternative_name", "x509_common_name")

# Whoever sits at the machine, as long as nobody has been named.
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
        call.principal = await asyncio.to_thread(self._caller, call.context)
        needed = rule_of(call.method).role
        if call.principal.role < needed:
            expected, found = f"a caller with the role {needed.label}", call.principal.role.label
            raise PermissionDeniedError(call.method, expected, found)
        yield

    def _caller(self, context: Any) -> Principal:
        authorization = dict(context.invocation_metadata() or ()).get("authorization")
        if authorization is not None:
            return _known(self._of_token(authorization), "a token that is not known")
        names = _certificate_names(context)
        if names:
            return _known(self._principals.of_names(names), "a certificate of nobody known")
        if is_local_peer(context.peer()) and self._principals.is_empty():
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


def _certificate_names(context: Any) -> list[str]:
    identity = context.auth_context()
    return [
        name.decode(errors="replace") for key in CERTIFICATE_NAMES for name in identity.get(key, ())
    ]


def is_local_peer(peer: str) -> bool:
    """Whether gRPC's name of a peer is an address of this machine alone."""
    family, _, address = unquote(peer).partition(":")
    if family == "unix":
        return True
    host = address.rpartition(":")[0].strip("[]")
    return is_loopback(host)


def is_loopback(host: str) -> bool:
    """Whether only this machine reaches the host."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
