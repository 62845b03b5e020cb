"""What each method asks of its caller: one table for access, audit and limits."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from types import MappingProxyType

from roel_service.store.principals import Role


class Pool(Enum):
    """What a call takes a place in."""

    # One pool for each method.
    METHOD = "method"
    # All uploads share one.
    UPLOADS = "uploads"
    # All questions that a warm child answers share one.
    INTERACTIVE = "interactive"
    # All streams of pictures or events that are located share one; each costs little by itself.
    STREAMS = "streams"
    # Never held up: a caller that only listens costs next to nothing.
    NONE = "none"


@dataclass(frozen=True, kw_only=True)
class Rule:
    """What a method asks of its caller.

    Attributes:
        role: the least that the caller must be.
        pool: where it takes a place.
        audited: whether it leaves a row in the audit.
    """

    role: Role
    pool: Pool = Pool.METHOD
    audited: bool = False


# Answers with poses, and with nothing of a map.
ANSWER = Rule(role=Role.LOCALIZE_ONLY)
CONVERSE = Rule(role=Role.LOCALIZE_ONLY, pool=Pool.STREAMS)
ASK = Rule(role=Role.LOCALIZE_ONLY, pool=Pool.INTERACTIVE)
LOOK = Rule(role=Role.READER)
WATCH = Rule(role=Role.READER, pool=Pool.NONE)
CHANGE = Rule(role=Role.BUILDER, audited=True)
UPLOAD = Rule(role=Role.BUILDER, pool=Pool.UPLOADS, audited=True)

# What is not listed is for the admin alone.
UNLISTED = Rule(role=Role.ADMIN, audited=True)

_METHODS: dict[str, dict[Rule, tuple[str, ...]]] = {
    "roel_service.v1.CapabilitiesService": {ANSWER: ("GetCapabilities",)},
    "roel_service.v1.BlobService": {
        LOOK: ("FindMissingBlobs", "QueryWriteStatus", "ReadBlob"),
        UPLOAD: ("WriteBlob",),
    },
    "roel_service.v1.EventStreamService": {
        LOOK: (
            "GetEventStream",
            "ListEventStreams",
            "QueryAppendStatus",
            "ReadEvents",
            "PreviewEvents",
        ),
        CHANGE: (
            "CreateEventStream",
            "FinalizeEventStream",
            "DeleteEventStream",
            "ImportEventStream",
        ),
        UPLOAD: ("AppendEvents", "AppendPoses"),
    },
    "roel_service.v1.MapService": {
        LOOK: (
            "GetMap",
            "ListMaps",
            "GetMapVersion",
            "ListMapVersions",
            "ExportMap",
            "GetLines",
            "SyncBlocks",
        ),
        CHANGE: (
            "CreateMap",
            "UpdateMap",
            "DeleteMap",
            "UndeleteMap",
            "BuildMap",
            "RefinePoses",
            "ImportMap",
            "DeleteMapVersion",
            "UndeleteMapVersion",
            "DeleteMapAlias",
            "PromoteMapVersion",
        ),
    },
    "roel_service.v1.RegistrationService": {
        ASK: ("Register",),
        CHANGE: ("BatchRegister",),
    },
    "roel_service.v1.LocalizationService": {
        ASK: ("Localize",),
        CONVERSE: ("StreamLocalize", "TrackPoses"),
        CHANGE: ("BatchLocalize",),
    },
    "roel_service.v1.OperationService": {WATCH: ("WatchOperation",)},
    "google.longrunning.Operations": {
        LOOK: ("GetOperation", "ListOperations"),
        WATCH: ("WaitOperation",),
        CHANGE: ("CancelOperation", "DeleteOperation"),
    },
}

RULES = MappingProxyType(
    {
        f"/{service}/{method}": rule
        for service, rules in _METHODS.items()
        for rule, methods in rules.items()
        for method in methods
    }
)


def rule_of(method: str) -> Rule:
    """The rule of `/package.Service/Method`."""
    return RULES.get(method, UNLISTED)
