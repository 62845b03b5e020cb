"""Where a server listens, and how that is protected."""

from __future__ import annotations

import ssl
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc

from roel_service.errors import InputError, UnavailableError
from roel_service.service.access import is_loopback


@dataclass(frozen=True, kw_only=True)
class Listen:
    """What the operator says about addresses.

    Attributes:
        host, port: port 0 takes a free one.
        socket: a Unix-domain socket in their place.
        tls_cert, tls_key: PEM files; without them calls are not encrypted.
        client_ca: PEM file of those who vouch for clients; every client then needs a certificate.
        insecure: allow another host than loopback without encryption.
        admin: host and port for metrics and probes; None does without.
    """

    host: str = "127.0.0.1"
    port: int = 50051
    socket: Path | None = None
    tls_cert: Path | None = None
    tls_key: Path | None = None
    client_ca: Path | None = None
    insecure: bool = False
    admin: tuple[str, int] | None = None

    @property
    def address(self) -> str:
        """As gRPC takes it."""
        if self.socket is not None:
            return f"unix:{self.socket}"
        return f"{self._shown_host}:{self.port}"

    @property
    def _shown_host(self) -> str:
        return f"[{self.host}]" if ":" in self.host else self.host

    def credentials(self) -> grpc.ServerCredentials | None:
        """As gRPC takes them; None for plain text.

        Raises:
            InputError: INSECURE_HOST; TLS_INVALID, files that are no certificate and its key.
        """
        if self.tls_cert is None or self.tls_key is None:
            self._check_plain()
            return None
        _check_pair(self.tls_cert, self.tls_key)
        client_ca = None if self.client_ca is None else _authorities(self.client_ca)
        return grpc.ssl_server_credentials(
            [(self.tls_key.read_bytes(), self.tls_cert.read_bytes())],
            root_certificates=client_ca,
            require_client_auth=client_ca is not None,
        )

    def _check_plain(self) -> None:
        for option, file in (
            ("--tls-cert", self.tls_cert),
            ("--tls-key", self.tls_key),
            ("--client-ca", self.client_ca),
        ):
            if file is not None:
                expected, found = "--tls-cert and --tls-key together", "not both"
                raise InputError(option, expected, found, reason="TLS_INVALID")
        if not (self.insecure or self.socket is not None or is_loopback(self.host)):
            expected = "a loopback address, or --tls-cert and --tls-key (--insecure does without)"
            raise InputError("--host", expected, self.host, reason="INSECURE_HOST")

    def bind(self, server: Any, credentials: grpc.ServerCredentials | None) -> str:
        """Listen; the address that was bound. Raises `UnavailableError`."""
        try:
            if credentials is None:
                bound = server.add_insecure_port(self.address)
            else:
                bound = server.add_secure_port(self.address, credentials)
        except RuntimeError as error:
            found = "one that cannot be listened on"
            raise UnavailableError(self.address, "a free address", found) from error
        return self.address if self.socket is not None else f"{self._shown_host}:{bound}"


def _check_pair(certificate: Path, key: Path) -> None:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except OSError as error:  # ssl's errors are of this kind too
        expected = "PEM files of a certificate and its key"
        raise _invalid(f"{certificate}, {key}", expected, error) from error


def _authorities(file: Path) -> bytes:
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT).load_verify_locations(file)
        return file.read_bytes()
    except OSError as error:
        raise _invalid(str(file), "a PEM file of certificates", error) from error


def _invalid(subject: str, expected: str, error: OSError) -> InputError:
    return InputError(subject, expected, error.strerror or str(error), reason="TLS_INVALID")
