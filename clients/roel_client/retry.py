"""How calls are made again: only when the server was unavailable, and only where that is safe."""

from __future__ import annotations

import json
import random
import time
from collections.abc import Callable
from typing import TypeVar

from roel_service.errors import UnavailableError

Result = TypeVar("Result")

# A second call of these changes nothing that the first one has not changed.
IDEMPOTENT_METHODS = {
    "roel_service.v1.CapabilitiesService": ("GetCapabilities",),
    "roel_service.v1.EventStreamService": (
        "GetEventStream",
        "ListEventStreams",
        "FinalizeEventStream",
    ),
    "roel_service.v1.MapService": ("GetMap", "ListMaps", "GetMapVersion", "ListMapVersions"),
    "google.longrunning.Operations": (
        "GetOperation",
        "ListOperations",
        "CancelOperation",
        "WaitOperation",
    ),
}

# gRPC repeats single calls by itself, about 1.5 s in all.
RETRY_POLICY = {
    "maxAttempts": 4,
    "initialBackoff": "0.2s",
    "maxBackoff": "2s",
    "backoffMultiplier": 2,
    "retryableStatusCodes": ["UNAVAILABLE"],
}

# Uploads and watches are taken up again where they broke; even a busy machine restarts a server
# within this time.
PAUSES_S = (0.2, 0.5, 1.0, 2.0, 4.0, 8.0)

_jitter = random.SystemRandom()


def service_config() -> str:
    """The retry policy as gRPC takes it."""
    names = [
        {"service": service, "method": method}
        for service, methods in IDEMPOTENT_METHODS.items()
        for method in methods
    ]
    return json.dumps({"methodConfig": [{"name": names, "retryPolicy": RETRY_POLICY}]})


def resumed(call: Callable[[], Result]) -> Result:
    """Result of a call that continues where it broke; made again after each of `PAUSES_S`.

    Raises:
        UnavailableError: the server stayed unavailable.
    """
    for pause_s in PAUSES_S:
        try:
            return call()
        except UnavailableError:
            time.sleep(pause_s * _jitter.uniform(0.5, 1.0))
    return call()
