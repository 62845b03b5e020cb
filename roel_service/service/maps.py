"""MapService: maps are named, made, looked up and fetched."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Iterable, Iterator, Sequence
from functools import partial
from typing import Any

from google.longrunning import operations_pb2

from roel_service.config.stages import Config
from roel_service.errors import ConfigError, InputError
from roel_service.jobs.preparation import build_parameters_to_bytes
from roel_service.jobs.scheduler import Scheduler
from roel_service.service.exports import Exporter
from roel_service.service.labels import checked_display_name, checked_labels, updated_fields
from roel_service.service.line_streams import conditions_from_proto, line_messages
from roel_service.service.operations import submitted
from roel_service.service.paging import page_of, page_request
from roel_service.service.records import map_to_proto, map_version_to_proto, write_map
from roel_service.service.requests import content_sha256, request_id
from roel_service.service.settings import Settings
from roel_service.store.builds import ImportedBlob
from roel_service.store.records import MapVersionRecord
from roel_service.store.store import Store
from roel_service.v1 import maps_pb2
from roel_service.wire import names
from roel_service.wire.configs import config_from_proto, config_to_proto
from roel_service.wire.nouns import trajectory_from_proto
from roel_service.wire.rlm import MapBlocks

DEFAULT_PRESET = "default"


class MapServicer:
    """Decodes requests, calls store or scheduler, encodes answers."""

    def __init__(
        self, store: Store, scheduler: Scheduler, exporter: Exporter, settings: Settings
    ) -> None:
        self._store = store
        self._scheduler = scheduler
        self._exporter = exporter
        self._settings = settings

    async def CreateMap(self, request: maps_pb2.CreateMapRequest, context: Any) -> maps_pb2.Map:
        names.check_parent(request.parent)
        record = await asyncio.to_thread(
            self._store.maps.create,
            names.checked_id(request.map_id, "map_id"),
            display_name=checked_display_name(request.map.display_name, self._settings),
            labels=checked_labels(request.map.labels, self._settings),
            request=request_id(request),
        )
        return map_to_proto(record)

    async def GetMap(self, request: maps_pb2.GetMapRequest, context: Any) -> maps_pb2.Map:
        map_id = names.map_id(request.name)
        return map_to_proto(await asyncio.to_thread(self._store.maps.get, map_id))

    async def ListMaps(
        self, request: maps_pb2.ListMapsRequest, context: Any
    ) -> maps_pb2.ListMapsResponse:
        names.check_parent(request.parent)
        scope = f"maps?show_deleted={request.show_deleted}"
        wanted = page_request(scope, request.page_size, request.page_token)
        fetch = partial(self._store.maps.page, show_deleted=request.show_deleted)
        page = await asyncio.to_thread(page_of, wanted, fetch, lambda item: item.id)
        response = maps_pb2.ListMapsResponse(next_page_token=page.next_page_token)
        for item in page.items:
            write_map(response.maps.add(), item)
        return response

    async def UpdateMap(self, request: maps_pb2.UpdateMapRequest, context: Any) -> maps_pb2.Map:
        map_id = names.map_id(request.map.name)
        values = updated_fields(request.map, list(request.update_mask.paths), self._settings)
        update = self._store.maps.update
        etag = request.map.etag
        record = await asyncio.to_thread(update, map_id, values, etag, request_id(request))
        return map_to_proto(record)

    async def DeleteMap(self, request: maps_pb2.DeleteMapRequest, context: Any) -> maps_pb2.Map:
        map_id = names.map_id(request.name)
        maps = self._store.maps
        delete = maps.purge if request.purge else maps.delete
        record = await asyncio.to_thread(delete, map_id, request.etag, request_id(request))
        return map_to_proto(record)

    async def UndeleteMap(self, request: maps_pb2.UndeleteMapRequest, context: Any) -> maps_pb2.Map:
        map_id = names.map_id(request.name)
        undelete = self._store.maps.undelete
        record = await asyncio.to_thread(undelete, map_id, request.etag, request_id(request))
        return map_to_proto(record)

    async def BuildMap(
        self, request: maps_pb2.BuildMapRequest, context: Any
    ) -> operations_pb2.Operation:
        map_id = names.map_id(request.parent)
        stream_id = names.event_stream_id(request.event_stream)
        config = _requested_config(request)
        if request.validate_only:
            version = await asyncio.to_thread(
                self._store.builds.check, map_id, stream_id, follow=request.follow
            )
            return _validated(map_id, version, request.event_stream)
        identity = request_id(request)
        begin = partial(
            self._store.builds.begin,
            map_id,
            stream_id,
            content_sha256(request),
            parameters=build_parameters_to_bytes(config),
            request=identity,
            follow=request.follow,
        )
        return await submitted(self._store, self._scheduler, begin, identity)

    async def RefinePoses(
        self, request: maps_pb2.RefinePosesRequest, context: Any
    ) -> operations_pb2.Operation:
        stream_id = names.event_stream_id(request.event_stream)
        target_map_id = names.map_id(request.target_map) if request.target_map else ""
        parameters = _refinement(request)
        fixed_map_sha256 = ""
        if request.map_version:
            fixed = await self._version(request.map_version)
            fixed_map_sha256 = (await asyncio.to_thread(self._store.maps.map_path, fixed)).name
            parameters.map_version = _name(fixed)
        identity = request_id(request)
        begin = partial(
            self._store.refinements.begin,
            stream_id,
            parameters.SerializeToString(deterministic=True),
            fixed_map_sha256=fixed_map_sha256,
            target_map_id=target_map_id,
            request_sha256=content_sha256(request),
            request=identity,
        )
        return await submitted(self._store, self._scheduler, begin, identity)

    async def ImportMap(
        self, request: maps_pb2.ImportMapRequest, context: Any
    ) -> operations_pb2.Operation:
        map_id = names.map_id(request.parent)
        file = await self._imported(request)
        identity = request_id(request)
        begin = partial(
            self._store.builds.begin_import, map_id, file, content_sha256(request), identity
        )
        return await submitted(self._store, self._scheduler, begin, identity)

    async def GetMapVersion(
        self, request: maps_pb2.GetMapVersionRequest, context: Any
    ) -> maps_pb2.MapVersion:
        return map_version_to_proto(await self._version(request.name))

    async def ListMapVersions(
        self, request: maps_pb2.ListMapVersionsRequest, context: Any
    ) -> maps_pb2.ListMapVersionsResponse:
        map_id = names.map_id(request.parent)
        scope = f"{request.parent}/versions"
        wanted = page_request(scope, request.page_size, request.page_token)
        fetch = partial(self._version_page, map_id)
        page = await asyncio.to_thread(page_of, wanted, fetch, lambda item: str(item.version))
        return maps_pb2.ListMapVersionsResponse(
            map_versions=[map_version_to_proto(item) for item in page.items],
            next_page_token=page.next_page_token,
        )

    async def DeleteMapVersion(
        self, request: maps_pb2.DeleteMapVersionRequest, context: Any
    ) -> maps_pb2.MapVersion:
        map_id, number = names.map_version_number(request.name)
        delete = self._store.maps.delete_version
        record = await asyncio.to_thread(delete, map_id, number, request_id(request))
        return map_version_to_proto(record)

    async def UndeleteMapVersion(
        self, request: maps_pb2.UndeleteMapVersionRequest, context: Any
    ) -> maps_pb2.MapVersion:
        map_id, number = names.map_version_number(request.name)
        undelete = self._store.maps.undelete_version
        record = await asyncio.to_thread(undelete, map_id, number, request_id(request))
        return map_version_to_proto(record)

    async def DeleteMapAlias(
        self, request: maps_pb2.DeleteMapAliasRequest, context: Any
    ) -> maps_pb2.Map:
        record = await asyncio.to_thread(
            self._store.maps.remove_alias,
            names.map_id(request.name),
            names.checked_alias(request.alias),
            etag=request.etag,
            request=request_id(request),
        )
        return map_to_proto(record)

    async def PromoteMapVersion(
        self, request: maps_pb2.PromoteMapVersionRequest, context: Any
    ) -> maps_pb2.Map:
        map_id, label = names.map_version_id(request.name)
        record = await asyncio.to_thread(
            self._store.maps.promote,
            map_id,
            label,
            names.checked_alias(request.alias),
            self._settings.alias_count,
            etag=request.etag,
            request=request_id(request),
        )
        return map_to_proto(record)

    async def ExportMap(
        self, request: maps_pb2.ExportMapRequest, context: Any
    ) -> AsyncIterator[maps_pb2.ExportMapResponse]:
        record = await self._version(request.name)
        async with self._exporter.file(record, request.format) as path:
            size_bytes = path.stat().st_size
            yield maps_pb2.ExportMapResponse(map_version=_name(record), size_bytes=size_bytes)
            with path.open("rb") as file:
                while data := await asyncio.to_thread(
                    file.read, self._settings.download_part_bytes
                ):
                    yield maps_pb2.ExportMapResponse(data=data)

    async def GetLines(
        self, request: maps_pb2.GetLinesRequest, context: Any
    ) -> AsyncIterator[maps_pb2.GetLinesResponse]:
        conditions = conditions_from_proto(request)
        record = await self._version(request.name)
        blocks = await asyncio.to_thread(self._blocks, record)
        max_line_count = self._settings.lines_per_message
        messages = line_messages(blocks, conditions, _name(record), max_line_count)
        # Each message in a thread: the front goes on meanwhile.
        while (message := await asyncio.to_thread(next, messages, None)) is not None:
            yield message

    async def SyncBlocks(
        self, request: maps_pb2.SyncBlocksRequest, context: Any
    ) -> maps_pb2.SyncBlocksResponse:
        record = await self._version(request.name)
        blocks = await asyncio.to_thread(self._blocks, record)
        digests = [blocks.sha256(block) for block in range(blocks.count)]
        held = set(request.held_block_sha256)
        missing = [block for block, digest in enumerate(digests) if digest not in held]
        return maps_pb2.SyncBlocksResponse(
            map_version=_name(record),
            head=blocks.head,
            block_sha256=digests,
            blocks=_fitting(blocks, missing, self._settings.message_out_bytes // 2),
            tail=blocks.tail,
        )

    async def _imported(self, request: maps_pb2.ImportMapRequest) -> ImportedBlob:
        """The file of an import, in the store."""
        source = request.WhichOneof("source")
        if source is None:
            raise InputError("source", "data or blob", "none")
        if source == "blob":
            sha256 = names.checked_sha256(request.blob.sha256)
            return ImportedBlob(sha256=sha256, size_bytes=request.blob.size_bytes)
        return await asyncio.to_thread(self._store.builds.put_import, request.data)

    async def _version(self, name: str) -> MapVersionRecord:
        return await asyncio.to_thread(self._store.maps.version, *names.map_version_id(name))

    def _blocks(self, record: MapVersionRecord) -> MapBlocks:
        return MapBlocks(self._store.maps.map_file(record), subject=_name(record))

    def _version_page(self, map_id: str, after: str, limit: int) -> Sequence[MapVersionRecord]:
        return self._store.maps.version_page(map_id, int(after or 0), limit)


def _name(record: MapVersionRecord) -> str:
    return names.map_version_name(record.map_id, record.version)


def _fitting(blocks: MapBlocks, wanted: Iterable[int], max_bytes: int) -> Iterator[bytes]:
    """The first of the wanted blocks, as many as fit; at least one."""
    sent_bytes = 0
    for block in wanted:
        data = blocks.stored(block)
        sent_bytes += len(data)
        if sent_bytes > max(max_bytes, len(data)):
            return
        yield data


def _validated(map_id: str, version: int, event_stream: str) -> operations_pb2.Operation:
    """What a build would begin."""
    operation = operations_pb2.Operation(done=True)
    message = maps_pb2.MapVersion(
        name=names.map_version_name(map_id, version), event_stream=event_stream
    )
    operation.response.Pack(message)
    return operation


def _refinement(request: maps_pb2.RefinePosesRequest) -> maps_pb2.RefinePosesRequest:
    """What a refinement needs to know beside rows; raises `ConfigError`, `TrajectoryError`."""
    config = _requested_config(request)
    estimates_more = request.estimate_time_offset or request.estimate_intrinsics
    if estimates_more and not request.map_version:
        config.refine.require_more_than_poses()
    parameters = maps_pb2.RefinePosesRequest(
        config=config_to_proto(config),
        estimate_time_offset=request.estimate_time_offset,
        estimate_intrinsics=request.estimate_intrinsics,
    )
    if request.HasField("trajectory"):
        trajectory_from_proto(request.trajectory)
        parameters.trajectory.CopyFrom(request.trajectory)
    return parameters


def _requested_config(
    request: maps_pb2.BuildMapRequest | maps_pb2.RefinePosesRequest,
) -> Config:
    """The configuration of a build or a refinement.

    Raises:
        ConfigError: of `config_from_proto`; a file is named: the server would open its own.
    """
    config = config_from_proto(request.config, request.preset or DEFAULT_PRESET)
    if config.match_global.checkpoint:
        expected = "none on a server, which opens no files that a client names"
        raise ConfigError("match_global.checkpoint", expected, config.match_global.checkpoint)
    return config
