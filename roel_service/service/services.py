"""The services of this server and who answers them."""

from __future__ import annotations

from typing import Any

from google.longrunning import operations_pb2, operations_pb2_grpc

from roel_service.jobs.asked import Questions
from roel_service.jobs.preparation import cache_place
from roel_service.jobs.scheduler import Scheduler
from roel_service.service.asking import Asking
from roel_service.service.batches import Batching
from roel_service.service.blobs import BlobServicer
from roel_service.service.capabilities import CapabilitiesServicer
from roel_service.service.event_streams import EventStreamServicer
from roel_service.service.exports import Exporter
from roel_service.service.following import Following
from roel_service.service.localization import LocalizationServicer
from roel_service.service.maps import MapServicer
from roel_service.service.methods import complete
from roel_service.service.operations import OperationServicer
from roel_service.service.registration import RegistrationServicer
from roel_service.service.settings import Settings
from roel_service.service.uploads import OpenUploads
from roel_service.store.records import OperationMethod
from roel_service.store.store import Store
from roel_service.v1 import (
    blobs_pb2,
    blobs_pb2_grpc,
    capabilities_pb2,
    capabilities_pb2_grpc,
    events_pb2,
    events_pb2_grpc,
    localization_pb2,
    localization_pb2_grpc,
    maps_pb2,
    maps_pb2_grpc,
    registration_pb2,
    registration_pb2_grpc,
)
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.v1 import operations_pb2_grpc as roel_operations_pb2_grpc

# The file that declares each service, and the function that adds its servicer.
_DECLARED = {
    "CapabilitiesService": (
        capabilities_pb2,
        capabilities_pb2_grpc.add_CapabilitiesServiceServicer_to_server,
    ),
    "BlobService": (blobs_pb2, blobs_pb2_grpc.add_BlobServiceServicer_to_server),
    "EventStreamService": (
        events_pb2,
        events_pb2_grpc.add_EventStreamServiceServicer_to_server,
    ),
    "MapService": (maps_pb2, maps_pb2_grpc.add_MapServiceServicer_to_server),
    "RegistrationService": (
        registration_pb2,
        registration_pb2_grpc.add_RegistrationServiceServicer_to_server,
    ),
    "LocalizationService": (
        localization_pb2,
        localization_pb2_grpc.add_LocalizationServiceServicer_to_server,
    ),
    "OperationService": (
        roel_operations_pb2,
        roel_operations_pb2_grpc.add_OperationServiceServicer_to_server,
    ),
    "Operations": (operations_pb2, operations_pb2_grpc.add_OperationsServicer_to_server),
}

_DESCRIPTORS = {
    name: module.DESCRIPTOR.services_by_name[name] for name, (module, _) in _DECLARED.items()
}

# Full names, such as `roel_service.v1.MapService`.
SERVICES = tuple(descriptor.full_name for descriptor in _DESCRIPTORS.values())


# Whoever wants to end or watch an operation is heard however many calls of other kinds there are.
_OWN_QUEUES = ("OperationService", "Operations")


class _Shared:
    """A server whose handlers share one queue of calls that nobody has looked at yet.

    A registered method has a queue of its own in gRPC, and for every call that comes asyncio looks at
    all of these queues: with those of every method, a third of what a lookup costs.
    """

    def __init__(self, server: Any) -> None:
        self._server = server

    def add_generic_rpc_handlers(self, handlers: Any) -> None:
        """Handlers by the names of their methods."""
        self._server.add_generic_rpc_handlers(handlers)

    def add_registered_method_handlers(self, service: str, handlers: Any) -> None:
        """Left out."""


def add_services(
    server: Any,
    store: Store,
    scheduler: Scheduler,
    exporter: Exporter,
    asking: Asking,
    following: Following,
    settings: Settings,
) -> None:
    """Add every service of the protocol; methods that nobody wrote yet refuse."""
    questions = Questions(
        store.maps,
        lambda sha256: store.uploads.path(store.uploads.use(sha256)),
        cache_place(store, settings.stage_cache_bytes),
        settings.inline_point_count,
    )
    registrations = Batching(
        store,
        scheduler,
        settings,
        OperationMethod.BATCH_REGISTER,
        registration_pb2.RegisterRequest,
        "cloud",
    )
    localizations = Batching(
        store,
        scheduler,
        settings,
        OperationMethod.BATCH_LOCALIZE,
        localization_pb2.LocalizeRequest,
        "image_blob",
    )
    operations = OperationServicer(store, scheduler)
    uploads = OpenUploads(settings.open_uploads)
    servicers: dict[str, object] = {
        "EventStreamService": EventStreamServicer(store, scheduler, uploads, settings),
        "BlobService": BlobServicer(store.uploads, uploads, settings),
        "MapService": MapServicer(store, scheduler, exporter, settings),
        "RegistrationService": RegistrationServicer(questions, asking, registrations),
        "LocalizationService": LocalizationServicer(
            questions, asking, localizations, following, settings
        ),
        "OperationService": operations,
        "Operations": operations,
    }
    answered = {descriptor: servicers.get(name) for name, descriptor in _DESCRIPTORS.items()}
    capabilities = CapabilitiesServicer(store, settings, answered)
    answered[_DESCRIPTORS["CapabilitiesService"]] = capabilities
    for descriptor, servicer in answered.items():
        _, add = _DECLARED[descriptor.name]
        add(
            complete(descriptor, servicer),
            server if descriptor.name in _OWN_QUEUES else _Shared(server),
        )
