"""CapabilitiesService: what this server is and how much it takes."""

from __future__ import annotations

from typing import Any

from roel_service import __version__
from roel_service.config.presets import PRESETS
from roel_service.scene.results import MAPPING_STAGES
from roel_service.service.settings import Settings
from roel_service.v1 import capabilities_pb2


class CapabilitiesServicer:
    """Answers from the settings alone."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings

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
        )
