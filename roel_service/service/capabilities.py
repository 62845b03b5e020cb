"""CapabilitiesService: what this server is and how much it takes."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from roel_service import __version__
from roel_service.config.presets import PRESETS
from roel_service.config.stages import DETECTORS, MATCHERS
from roel_service.io.foreign_maps import FOREIGN_FORMATS
from roel_service.io.maps import EXPORT_FORMATS
from roel_service.scene.results import MAPPING_STAGES
from roel_service.service.methods import is_implemented, method_name
from roel_service.service.settings import Settings
from roel_service.store.quotas import CALLER
from roel_service.store.store import Store
from roel_service.v1 import capabilities_pb2
from roel_service.wire import chunks, rlm


class CapabilitiesServicer:
    """Answers from the settings, the code, the servicers and the store.

    Args:
        servicers: what answers each service, by its descriptor; this one is among them.
    """

    def __init__(self, store: Store, settings: Settings, servicers: Mapping[Any, object]) -> None:
        self._store = store
        self._settings = settings
        self._servicers = servicers

    async def GetCapabilities(
        self, request: capabilities_pb2.GetCapabilitiesRequest, context: Any
    ) -> capabilities_pb2.Capabilities:
        fields = capabilities_pb2.Limits.DESCRIPTOR.fields_by_name
        limits = {name: getattr(self._settings, name) for name in fields}
        return capabilities_pb2.Capabilities(
            version=__version__,
            limits=capabilities_pb2.Limits(**limits),
            presets=list(PRESETS),
            stages=MAPPING_STAGES,
            chunk_versions=[chunks.CHUNK_VERSION],
            chunk_encodings=["columnar-zstd"],
            map_file_version=f"{rlm.FORMAT_MAJOR}.{rlm.FORMAT_MINOR}",
            import_formats=["rlm", *FOREIGN_FORMATS],
            export_formats=["rlm", *EXPORT_FORMATS],
            detectors=DETECTORS,
            matchers=MATCHERS,
            methods=self._methods(),
            usage=capabilities_pb2.Usage(**asdict(await asyncio.to_thread(self._store.usage))),
            quota=await asyncio.to_thread(self._quota),
        )

    def _quota(self) -> capabilities_pb2.Quota:
        caller = CALLER.get()
        has, may = self._store.holdings(caller), caller.quota
        return capabilities_pb2.Quota(
            caller=caller.name,
            stored_bytes=has.stored_bytes,
            event_stream_count=has.event_streams,
            unfinished_operation_count=has.unfinished_operations,
            max_stored_bytes=may.stored_bytes,
            max_event_stream_count=may.event_streams,
            max_unfinished_operation_count=may.unfinished_operations,
        )

    def _methods(self) -> list[capabilities_pb2.Method]:
        methods = (
            capabilities_pb2.Method(
                name=method_name(method), implemented=is_implemented(servicer, method)
            )
            for service, servicer in self._servicers.items()
            for method in service.methods
        )
        return sorted(methods, key=lambda method: method.name)
