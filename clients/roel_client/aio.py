"""The asynchronous client: recordings up, maps down.

`client.py`, the client for code without an event loop, is generated from this file by
`clients/generate.py`.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import tempfile
import uuid
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from google.longrunning import operations_pb2, operations_pb2_grpc
from google.protobuf.field_mask_pb2 import FieldMask
from google.protobuf.message import Message

from roel_client.connection import AsyncConnection, AsyncExchange, Endpoint, Tls
from roel_client.embedded import async_served
from roel_client.retry import RESUMING, Attempts, RetryPolicy
from roel_client.uploads import (
    BlobDownload,
    BlobUpload,
    EventUpload,
    MapDownload,
    events_of_chunk,
    lines_of_message,
    map_format,
)
from roel_service.arrays import Array, FloatArray
from roel_service.config.stages import Config, LocalizeConfig, RegisterConfig, TrackConfig
from roel_service.errors import CorruptionError, RoelError
from roel_service.geometry.se3 import SE3
from roel_service.progress import ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSlice, EventSource, EventStream
from roel_service.scene.lines import LineMap
from roel_service.scene.results import TrackedPose
from roel_service.scene.trajectory import Trajectory
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
    types_pb2,
)
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.v1 import operations_pb2_grpc as roel_operations_pb2_grpc
from roel_service.wire import names
from roel_service.wire.chunks import encode_chunk, split_chunks
from roel_service.wire.configs import config_to_proto
from roel_service.wire.delimited import delimited, messages
from roel_service.wire.errors import error_from_status
from roel_service.wire.localization import localize_request, prior_to_proto
from roel_service.wire.nouns import (
    bounds_to_proto,
    camera_to_proto,
    trajectory_from_proto,
    trajectory_to_proto,
)
from roel_service.wire.registration import register_request
from roel_service.wire.results import Report, progress_from_proto, report_from_proto
from roel_service.wire.tracking import guess_to_proto, tracked_pose_from_proto, tracking_setup

Result = TypeVar("Result")

# Sealing a recording reads it once.
FINALIZE_TIMEOUT_S = 300.0

DEFAULT_RETRY = RetryPolicy()

# The first answer waits for a child that starts, and for a cloud that is prepared.
ANSWER_TIMEOUT_S = 120.0

# What operations answer with, by their full names.
ANSWERS = {
    kind.DESCRIPTOR.full_name: kind
    for kind in (
        events_pb2.EventStream,
        maps_pb2.MapVersion,
        maps_pb2.RefinePosesResponse,
        registration_pb2.BatchRegisterResponse,
        localization_pb2.BatchLocalizeResponse,
    )
}
BATCH_ITEMS = {
    "BatchRegisterResponse": registration_pb2.BatchRegisterItem,
    "BatchLocalizeResponse": localization_pb2.BatchLocalizeItem,
}
# No answer is larger than a message.
MAX_ITEM_BYTES = 8 * 2**20

# About 0.8 MiB a message.
POSES_PER_MESSAGE = 8192


class AsyncClient:
    """One server; a context manager.

    Every method raises the `RoelError` that the server raised, and `UnavailableError` when there
    is no server. Single calls are repeated where that is safe, uploads and watches go on where they
    broke. Requests that change something carry an id made once for all attempts of a call.

    Args:
        address: `HOST:PORT`, or `unix:PATH`.
        token: says who calls, to a server that asks.
        tls: how the connection is encrypted; None speaks in plain text.
        timeout_s: so long a single call may take, with all its attempts.
        retry: how single calls are repeated.
    """

    def __init__(
        self,
        address: str,
        *,
        token: str | None = None,
        tls: Tls | None = None,
        timeout_s: float = 10.0,
        retry: RetryPolicy = DEFAULT_RETRY,
    ) -> None:
        endpoint = Endpoint(address=address, token=token, tls=tls, timeout_s=timeout_s, retry=retry)
        self._connection = AsyncConnection(endpoint)
        channel = self._connection.channel
        self._capabilities = capabilities_pb2_grpc.CapabilitiesServiceStub(channel)
        self._blobs = blobs_pb2_grpc.BlobServiceStub(channel)
        self._streams = events_pb2_grpc.EventStreamServiceStub(channel)
        self._maps = maps_pb2_grpc.MapServiceStub(channel)
        self._localization = localization_pb2_grpc.LocalizationServiceStub(channel)
        self._registration = registration_pb2_grpc.RegistrationServiceStub(channel)

    @classmethod
    @contextlib.asynccontextmanager
    async def embedded(cls, data: Path) -> AsyncIterator[AsyncClient]:
        """A client of a server in this process, on a folder of its own; no port is opened.

        Raises:
            StateError: DATA_IN_USE, a server uses the folder.
        """
        async with async_served(data) as address, cls(address) as client:
            yield client

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *error: object) -> None:
        await self.close()

    async def close(self) -> None:
        """End the connection."""
        await self._connection.close()

    async def capabilities(self) -> capabilities_pb2.Capabilities:
        """Version, limits, presets and stages of the server."""
        request = capabilities_pb2.GetCapabilitiesRequest()
        return await self._connection.call(self._capabilities.GetCapabilities, request)

    async def map_recording(
        self,
        events: EventSource,
        trajectory: Trajectory,
        camera: Camera,
        config: Config,
        progress: ProgressCallback = ignore,
    ) -> tuple[bytes, Report]:
        """Let the server build a map as `build_map` would in process; nothing stays there.

        Returns:
            The bytes of the map file, and the report.
        """
        built = await self.map_recording_with_poses(events, trajectory, camera, config, progress)
        return built[0], built[1]

    async def map_recording_with_poses(
        self,
        events: EventSource,
        trajectory: Trajectory,
        camera: Camera,
        config: Config,
        progress: ProgressCallback = ignore,
    ) -> tuple[bytes, Report, Trajectory | None]:
        """The same, and the poses of the map; None unless they were refined."""
        async with (
            self.hosted_recording(events, trajectory, camera, progress) as stream,
            self._temporary_map() as map_name,
        ):
            operation = await self.build_map(map_name, stream, config)
            version = await operation.wait(progress)
            poses = None
            if version.HasField("trajectory"):
                poses = await self.download_poses(version.trajectory)
            rlm_bytes = await self.download_map(version.name)
            return rlm_bytes, report_from_proto(version.report), poses

    async def refine_recording(
        self,
        events: EventSource,
        trajectory: Trajectory,
        camera: Camera,
        config: Config,
        map_version: str | None = None,
        progress: ProgressCallback = ignore,
        *,
        estimate_time_offset: bool = False,
        estimate_intrinsics: bool = False,
    ) -> tuple[Trajectory, maps_pb2.RefinePosesResponse]:
        """Let the server refine poses as `refine_poses` would in process; no recording stays there.

        Args:
            map_version: a map that stays as it is; None refines lines and poses together.
            estimate_time_offset: the clock of the poses may run beside that of the events.
            estimate_intrinsics: focal length and principal point may be off; takes
                fourteen times as long, or up to three times that if they are.
        """
        async with self.hosted_recording(events, trajectory, camera, progress) as stream:
            operation = await self.refine_poses(
                stream,
                config,
                map_version=map_version,
                estimate_time_offset=estimate_time_offset,
                estimate_intrinsics=estimate_intrinsics,
            )
            answer = await operation.wait(progress)
            return await self.download_poses(answer.trajectory), answer

    @contextlib.asynccontextmanager
    async def hosted_recording(
        self,
        events: EventSource,
        trajectory: Trajectory,
        camera: Camera,
        progress: ProgressCallback = ignore,
    ) -> AsyncIterator[str]:
        """Name of a finalized recording that is there as long as the block lasts."""
        async with self._temporary_stream(camera) as stream:
            await self.upload_poses(stream, trajectory)
            await self.upload_events(stream, events, progress)
            await self.finalize(stream)
            yield stream

    async def create_event_stream(
        self, stream_id: str, camera: Camera, labels: Mapping[str, str] | None = None
    ) -> str:
        """Open a recording; its name."""
        request = events_pb2.CreateEventStreamRequest(
            parent=names.PROJECT,
            event_stream_id=stream_id,
            event_stream=events_pb2.EventStream(camera=camera_to_proto(camera), labels=labels),
        )
        created = await self._connection.call(self._streams.CreateEventStream, request)
        return str(created.name)

    async def upload_events(
        self, stream: str, source: EventSource, progress: ProgressCallback = ignore
    ) -> events_pb2.EventStream:
        """Append a whole source; a broken upload is taken up where the server's record ends.

        A recording that holds events already is taken to hold the first ones of this source.
        Progress tells how many events are durable.
        """
        upload = EventUpload(source, progress)
        try:
            await _resumed(
                lambda: self._append_events(stream, upload), lambda: upload.committed_seq
            )
        finally:
            await self._connection.run(upload.close)
        return await self.event_stream(stream)

    async def upload_poses(self, stream: str, trajectory: Trajectory) -> events_pb2.EventStream:
        """Append poses."""
        requests = _pose_requests(stream, trajectory)
        return await self._connection.upload(self._streams.AppendPoses, requests)

    async def finalize(self, stream: str) -> events_pb2.EventStream:
        """Freeze a recording."""
        request = events_pb2.FinalizeEventStreamRequest(name=stream)
        method = self._streams.FinalizeEventStream
        return await self._connection.call(method, request, timeout_s=FINALIZE_TIMEOUT_S)

    async def event_stream(self, name: str) -> events_pb2.EventStream:
        """What the server has of a recording."""
        request = events_pb2.GetEventStreamRequest(name=name)
        return await self._connection.call(self._streams.GetEventStream, request)

    async def event_streams(self) -> list[events_pb2.EventStream]:
        """All recordings, in the order of their ids."""
        request = events_pb2.ListEventStreamsRequest(parent=names.PROJECT)
        return await self._listed(self._streams.ListEventStreams, request)

    async def read_events(
        self, name: str, start_us: int | None = None, stop_us: int | None = None
    ) -> AsyncIterator[EventSlice]:
        """Events start_us <= t < stop_us of a recording, in pieces; by default all of them."""
        request = events_pb2.ReadEventsRequest(name=name, start_us=start_us, stop_us=stop_us)
        chunks = self._connection.stream(self._streams.ReadEvents, request)
        async with contextlib.aclosing(chunks):
            async for chunk in chunks:
                yield await self._connection.run(events_of_chunk, chunk, start_us, stop_us)

    async def preview_events(self, name: str, start_us: int, stop_us: int) -> bytes:
        """A picture of the events start_us <= t < stop_us, as a PNG file."""
        request = events_pb2.PreviewEventsRequest(name=name, start_us=start_us, stop_us=stop_us)
        answer = await self._connection.call(self._streams.PreviewEvents, request)
        return bytes(answer.png)

    async def delete_event_stream(self, name: str) -> None:
        """Delete a recording."""
        request = events_pb2.DeleteEventStreamRequest(name=name)
        await self._connection.call(self._streams.DeleteEventStream, request)

    async def upload_blob(
        self, path: Path, progress: ProgressCallback = ignore
    ) -> types_pb2.BlobRef:
        """Upload a file, unless the server has it; a broken upload is taken up where it ended."""
        upload = await self._connection.run(BlobUpload, path, progress)
        await _resumed(lambda: self._write_blob(upload), lambda: upload.committed_bytes)
        return upload.blob

    async def download_blob(self, sha256: str, path: Path) -> None:
        """Fetch a blob as a file; raises `CorruptionError` unless it is what its name says."""
        download = BlobDownload(sha256, path)
        try:
            await _resumed(lambda: self._read_blob(download), lambda: download.received_bytes)
            download.finish()
        finally:
            download.close()

    async def create_map(self, map_id: str) -> str:
        """Name a map; its resource name."""
        request = maps_pb2.CreateMapRequest(parent=names.PROJECT, map_id=map_id)
        created = await self._connection.call(self._maps.CreateMap, request)
        return str(created.name)

    async def build_map(
        self, map_name: str, stream: str, config: Config, *, follow: bool = False
    ) -> AsyncOperation:
        """Begin to build a new version of a map from a recording.

        Args:
            follow: the recording may still be open; lines are looked for while it arrives.
        """
        request = maps_pb2.BuildMapRequest(
            parent=map_name, event_stream=stream, config=config_to_proto(config), follow=follow
        )
        begun = await self._connection.call(self._maps.BuildMap, request)
        return self.operation(begun.name)

    async def refine_poses(
        self,
        stream: str,
        config: Config,
        *,
        map_version: str | None = None,
        target_map: str | None = None,
        estimate_time_offset: bool = False,
        estimate_intrinsics: bool = False,
    ) -> AsyncOperation:
        """Begin to refine the poses of a recording.

        Args:
            map_version: a map that stays as it is; None refines lines and poses together.
            target_map: a map that gets a version of the lines seen from the refined poses.
            estimate_time_offset: the clock of the poses may run beside that of the events.
            estimate_intrinsics: focal length and principal point may be off; takes
                fourteen times as long, or up to three times that if they are.
        """
        request = maps_pb2.RefinePosesRequest(
            event_stream=stream,
            map_version=map_version,
            target_map=target_map,
            config=config_to_proto(config),
            estimate_time_offset=estimate_time_offset,
            estimate_intrinsics=estimate_intrinsics,
        )
        begun = await self._connection.call(self._maps.RefinePoses, request)
        return self.operation(begun.name)

    async def download_poses(self, blob: types_pb2.BlobRef) -> Trajectory:
        """The poses of a refinement, or of a version."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "poses")
            await self.download_blob(blob.sha256, path)
            return trajectory_from_proto(types_pb2.Trajectory.FromString(path.read_bytes()))

    async def import_map(self, map_name: str, path: Path) -> AsyncOperation:
        """Begin to make a new version of a map from a file of lines."""
        blob = await self.upload_blob(path)
        request = maps_pb2.ImportMapRequest(parent=map_name, blob=blob)
        begun = await self._connection.call(self._maps.ImportMap, request)
        return self.operation(begun.name)

    @contextlib.asynccontextmanager
    async def hosted_map(self, path: Path) -> AsyncIterator[str]:
        """Name of a version made from a file of lines, there as long as the block lasts."""
        async with self._temporary_map() as map_name:
            operation = await self.import_map(map_name, path)
            version = await operation.wait()
            yield version.name

    async def register(
        self,
        map_version: str,
        target: str | types_pb2.BlobRef | Array,
        *,
        T_init: SE3 | None = None,
        method: str = "auto",
        up_source: FloatArray | None = None,
        up_target: FloatArray | None = None,
        config: RegisterConfig | None = None,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> registration_pb2.RegisterResponse:
        """Where a map lies in a cloud, or in another map.

        Args:
            map_version: name of the version that is laid over the target.
            target: name of a version, an uploaded cloud, or (N, 3) points, m.
            T_init: first T_target_source; the identity by default.
            method: `auto`, `point`, `plane`, `line`, or `global`, which takes no first guess.
            up_source, up_target: (3,) unit, which way is up on both sides, for `global`; z by default.
            config: parameters; those of the server by default.
        """
        request = register_request(
            map_version,
            target,
            T_init=T_init,
            method=method,
            up_source=up_source,
            up_target=up_target,
            config=config,
        )
        call = self._registration.Register
        return await self._connection.call(call, request, timeout_s=timeout_s)

    async def localize(
        self,
        map_versions: Sequence[str],
        image: bytes | types_pb2.BlobRef,
        *,
        T_prior: SE3 | None = None,
        camera: Camera | None = None,
        max_hypothesis_count: int = 0,
        config: LocalizeConfig | None = None,
        timeout_s: float = ANSWER_TIMEOUT_S,
    ) -> localization_pb2.LocalizeResponse:
        """Where a picture was taken.

        Args:
            map_versions: names of the versions that may hold the place.
            image: JPEG or PNG, or an uploaded one.
            T_prior: first T_world_panorama.
            camera: that of an ordinary photograph, which needs a prior; None for a panorama.
            max_hypothesis_count: most answers; 0 takes what the parameters say.
            config: parameters; those of the server by default.
        """
        request = localize_request(
            map_versions,
            T_prior=T_prior,
            camera=camera,
            max_hypothesis_count=max_hypothesis_count,
            config=config,
        )
        if isinstance(image, bytes):
            request.image = image
        else:
            request.image_blob.CopyFrom(image)
        return await self._connection.call(
            self._localization.Localize, request, timeout_s=timeout_s
        )

    @contextlib.asynccontextmanager
    async def localizing(
        self,
        map_versions: Sequence[str],
        *,
        T_prior: SE3 | None = None,
        max_hypothesis_count: int = 0,
        config: LocalizeConfig | None = None,
    ) -> AsyncIterator[AsyncPictureStream]:
        """A stream of pictures, answered in their order; arguments as of `localize`."""
        setup = localize_request(
            map_versions, T_prior=T_prior, max_hypothesis_count=max_hypothesis_count, config=config
        )
        async with self._connection.exchange(self._localization.StreamLocalize) as exchange:
            await exchange.send(localization_pb2.StreamLocalizeRequest(setup=setup))
            accepted = (await exchange.receive()).accepted
            yield AsyncPictureStream(exchange, accepted)

    async def batch_register(
        self, requests: Sequence[registration_pb2.RegisterRequest]
    ) -> AsyncOperation:
        """Begin many registrations, of which each has an answer or an error of its own.

        Args:
            requests: as `wire.registration.register_request` makes them.
        """
        manifest = await self._manifest(requests)
        request = registration_pb2.BatchRegisterRequest(parent=names.PROJECT, manifest=manifest)
        begun = await self._connection.call(self._registration.BatchRegister, request)
        return self.operation(begun.name)

    async def batch_localize(
        self, requests: Sequence[localization_pb2.LocalizeRequest]
    ) -> AsyncOperation:
        """Begin to localize many pictures, of which each has an answer or an error of its own.

        Args:
            requests: as `wire.localization.localize_request` makes them, with their pictures.
        """
        manifest = await self._manifest(requests)
        request = localization_pb2.BatchLocalizeRequest(parent=names.PROJECT, manifest=manifest)
        begun = await self._connection.call(self._localization.BatchLocalize, request)
        return self.operation(begun.name)

    async def batch_items(
        self,
        answer: registration_pb2.BatchRegisterResponse | localization_pb2.BatchLocalizeResponse,
    ) -> list[registration_pb2.BatchRegisterItem] | list[localization_pb2.BatchLocalizeItem]:
        """The items of a batch that has ended, in the order of its requests."""
        kind = BATCH_ITEMS[answer.DESCRIPTOR.name]
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "items")
            await self.download_blob(answer.items.sha256, path)
            with path.open("rb") as file:
                return list(messages(file, kind, subject="items", max_bytes=MAX_ITEM_BYTES))

    async def _manifest(self, requests: Sequence[Message]) -> types_pb2.BlobRef:
        """The requests as a file that the server has."""
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder, "manifest")
            path.write_bytes(b"".join(map(delimited, requests)))
            return await self.upload_blob(path)

    @contextlib.asynccontextmanager
    async def tracking(
        self,
        map_version: str,
        camera: Camera,
        T_world_camera: SE3,
        *,
        t_us: int = 0,
        config: TrackConfig | None = None,
    ) -> AsyncIterator[AsyncTracking]:
        """A camera that is followed in a map, events up and poses down.

        It begins once the server is ready for the events, at once or after a few seconds.

        Args:
            map_version: name of the version that holds the place.
            camera: calibration of the sensor.
            T_world_camera: about where it is, within `config.reach_m` and `reach_deg`.
            t_us: when it is there; earlier events are passed over.
            config: parameters; those of the server by default.
        """
        setup = tracking_setup(map_version, camera, T_world_camera, t_us, config)
        async with self._connection.exchange(self._localization.TrackPoses) as exchange:
            await exchange.send(localization_pb2.TrackPosesRequest(setup=setup))
            await exchange.heard()
            yield AsyncTracking(exchange)

    def operation(self, name: str) -> AsyncOperation:
        """An operation that was begun before, perhaps by somebody else."""
        return AsyncOperation(self._connection, name)

    async def operations(self) -> list[operations_pb2.Operation]:
        """All operations that are remembered."""
        stub = operations_pb2_grpc.OperationsStub(self._connection.channel)
        return await self._listed(stub.ListOperations, operations_pb2.ListOperationsRequest())

    async def map_version(self, name: str) -> maps_pb2.MapVersion:
        """One version of a map; its last part may be `latest`."""
        request = maps_pb2.GetMapVersionRequest(name=name)
        return await self._connection.call(self._maps.GetMapVersion, request)

    async def download_map(self, name: str) -> bytes:
        """The map file of a version; raises `CorruptionError` unless it is what was built."""
        version = await self.map_version(name)
        request = maps_pb2.ExportMapRequest(name=version.name)
        parts = self._connection.stream(self._maps.ExportMap, request)
        data = b"".join([part.data async for part in parts])
        found = hashlib.sha256(data).hexdigest()
        if found != version.map.sha256:
            raise CorruptionError(version.name, f"bytes of digest {version.map.sha256}", found)
        return data

    async def export_map(self, name: str, path: Path, export_format: str) -> None:
        """A version as a file: `rlm`, `npz`, `ply`, `obj`, `json`, `csv` or `dxf`."""
        request = maps_pb2.ExportMapRequest(name=name, format=map_format(export_format))
        download = MapDownload(path)
        answers = self._connection.stream(self._maps.ExportMap, request)
        try:
            async with contextlib.aclosing(answers):
                async for answer in answers:
                    await self._connection.run(download.receive, answer)
            download.finish()
        finally:
            download.close()

    async def lines(
        self,
        name: str,
        bounds_m: FloatArray | None = None,
        *,
        min_length_m: float = 0.0,
        min_observation_count: int = 0,
    ) -> AsyncIterator[LineMap]:
        """The lines of a version that meet some conditions, in pieces.

        Args:
            name: of the version; its last part may be an alias.
            bounds_m: (2, 3) corners of a box that a line must reach into; None for anywhere.
        """
        request = maps_pb2.GetLinesRequest(
            name=name,
            bounds=None if bounds_m is None else bounds_to_proto(*bounds_m),
            min_length_m=min_length_m,
            min_observation_count=min_observation_count,
        )
        answers = self._connection.stream(self._maps.GetLines, request)
        async with contextlib.aclosing(answers):
            async for answer in answers:
                yield lines_of_message(answer)

    async def map(self, name: str) -> maps_pb2.Map:
        """A map without its lines: aliases, labels, etag."""
        request = maps_pb2.GetMapRequest(name=name)
        return await self._connection.call(self._maps.GetMap, request)

    async def maps(self, *, show_deleted: bool = False) -> list[maps_pb2.Map]:
        """All maps, in the order of their ids."""
        request = maps_pb2.ListMapsRequest(parent=names.PROJECT, show_deleted=show_deleted)
        return await self._listed(self._maps.ListMaps, request)

    async def map_versions(self, map_name: str) -> list[maps_pb2.MapVersion]:
        """All versions of a map, oldest first."""
        request = maps_pb2.ListMapVersionsRequest(parent=map_name)
        return await self._listed(self._maps.ListMapVersions, request)

    async def update_map(
        self,
        name: str,
        *,
        display_name: str | None = None,
        labels: Mapping[str, str] | None = None,
        etag: str = "",
    ) -> maps_pb2.Map:
        """Change what is given; labels are replaced as a whole."""
        changes = {"display_name": display_name, "labels": labels}
        paths = [field for field, value in changes.items() if value is not None]
        changed = maps_pb2.Map(name=name, display_name=display_name, labels=labels, etag=etag)
        request = maps_pb2.UpdateMapRequest(map=changed, update_mask=FieldMask(paths=paths))
        return await self._connection.call(self._maps.UpdateMap, request)

    async def promote(self, version_name: str, alias: str, *, etag: str = "") -> maps_pb2.Map:
        """Let an alias name a version; naming an older one than before rolls back."""
        request = maps_pb2.PromoteMapVersionRequest(name=version_name, alias=alias, etag=etag)
        return await self._connection.call(self._maps.PromoteMapVersion, request)

    async def delete_alias(self, map_name: str, alias: str, *, etag: str = "") -> maps_pb2.Map:
        """Let an alias name nothing."""
        request = maps_pb2.DeleteMapAliasRequest(name=map_name, alias=alias, etag=etag)
        return await self._connection.call(self._maps.DeleteMapAlias, request)

    async def import_events(
        self, stream: str, path: Path, progress: ProgressCallback = ignore
    ) -> AsyncOperation:
        """Upload a recording's file as it is, and begin to fill an empty recording from it."""
        blob = await self.upload_blob(path, progress)
        request = events_pb2.ImportEventStreamRequest(name=stream, blob=blob)
        begun = await self._connection.call(self._streams.ImportEventStream, request)
        return self.operation(begun.name)

    async def delete_map_version(self, name: str) -> maps_pb2.MapVersion:
        """Delete a version that no alias names; it can be undeleted."""
        request = maps_pb2.DeleteMapVersionRequest(name=name)
        return await self._connection.call(self._maps.DeleteMapVersion, request)

    async def undelete_map_version(self, name: str) -> maps_pb2.MapVersion:
        """Take the deletion of a version back."""
        request = maps_pb2.UndeleteMapVersionRequest(name=name)
        return await self._connection.call(self._maps.UndeleteMapVersion, request)

    async def undelete_map(self, name: str) -> maps_pb2.Map:
        """Take the deletion of a map back."""
        request = maps_pb2.UndeleteMapRequest(name=name)
        return await self._connection.call(self._maps.UndeleteMap, request)

    async def delete_map(self, name: str, *, purge: bool = False) -> None:
        """Delete a map with all its versions; it can be undeleted unless it is purged."""
        request = maps_pb2.DeleteMapRequest(name=name, purge=purge)
        await self._connection.call(self._maps.DeleteMap, request)

    async def _listed(self, method: Any, request: Any) -> list[Any]:
        """All items of a list, page by page; the first field of an answer holds them."""
        found: list[Any] = []
        while True:
            page = await self._connection.call(method, request)
            found += getattr(page, page.DESCRIPTOR.fields[0].name)
            if not page.next_page_token:
                return found
            request.page_token = page.next_page_token

    async def _append_events(self, stream: str, upload: EventUpload) -> None:
        async with self._connection.exchange(self._streams.AppendEvents) as exchange:
            await exchange.send(events_pb2.AppendEventsRequest(event_stream=stream))
            upload.restart(await exchange.receive())
            while (chunk := await self._connection.run(upload.next_chunk)) is not None:
                while not upload.has_credit(chunk):
                    upload.acknowledge(await exchange.receive())
                await exchange.send(chunk.request())
            await exchange.finish()
            while (status := await exchange.receive()) is not None:
                upload.acknowledge(status)

    async def _write_blob(self, upload: BlobUpload) -> None:
        async with self._connection.exchange(self._blobs.WriteBlob) as exchange:
            await exchange.send(upload.header())
            status = await exchange.receive()
            upload.restart(status)
            while (part := await self._connection.run(upload.next_part)) is not None:
                while not upload.has_credit():
                    upload.acknowledge(await exchange.receive())
                await exchange.send(part)
            await exchange.send(blobs_pb2.WriteBlobRequest(finish=blobs_pb2.WriteBlobFinish()))
            await exchange.finish()
            while not status.HasField("blob"):
                status = await exchange.receive()
                upload.acknowledge(status)

    async def _read_blob(self, download: BlobDownload) -> None:
        answers = self._connection.stream(self._blobs.ReadBlob, download.request())
        async with contextlib.aclosing(answers):
            async for answer in answers:
                await self._connection.run(download.receive, answer)

    @contextlib.asynccontextmanager
    async def _temporary_stream(self, camera: Camera) -> AsyncIterator[str]:
        name = await self.create_event_stream(_temporary_id(), camera)
        try:
            yield name
        finally:
            with contextlib.suppress(RoelError):
                await self.delete_event_stream(name)

    @contextlib.asynccontextmanager
    async def _temporary_map(self) -> AsyncIterator[str]:
        name = await self.create_map(_temporary_id())
        try:
            yield name
        finally:
            with contextlib.suppress(RoelError):
                await self.delete_map(name, purge=True)


class AsyncPictureStream:
    """Pictures of a robot on their way; sending and receiving may be two tasks.

    Attributes:
        map_versions: the versions that are searched.
        credit_pictures: so many pictures may be unanswered.
    """

    def __init__(self, exchange: AsyncExchange, accepted: localization_pb2.StreamAccepted) -> None:
        self._exchange = exchange
        self.map_versions = list(accepted.map_versions)
        self.credit_pictures = int(accepted.credit_pictures)

    async def send(self, picture_id: int, image: bytes, *, T_prior: SE3 | None = None) -> None:
        """The next picture, JPEG or PNG; its id comes back with its answer."""
        picture = localization_pb2.StreamPicture(picture_id=picture_id, image=image)
        if T_prior is not None:
            picture.prior.CopyFrom(prior_to_proto(T_prior))
        await self._exchange.send(localization_pb2.StreamLocalizeRequest(picture=picture))

    async def finish(self) -> None:
        """Say that no picture follows."""
        await self._exchange.finish()

    async def receive(self) -> localization_pb2.StreamLocalizeResponse | None:
        """The next answer, or why there is none; None after the last."""
        return await self._exchange.receive()


class AsyncTracking:
    """Events of a camera on their way; sending and receiving may be two tasks.

    A server reads a few messages further than it has got with its work; what is sent faster waits
    here.
    """

    def __init__(self, exchange: AsyncExchange) -> None:
        self._exchange = exchange
        self._seq = 0

    async def send(self, events: EventStream) -> None:
        """The next events."""
        for part in split_chunks(events):
            chunk = events_pb2.EventChunk(seq=self._seq, data=encode_chunk(part))
            await self._exchange.send(localization_pb2.TrackPosesRequest(chunk=chunk))
            self._seq += 1

    async def guess(self, T_world_camera: SE3) -> None:
        """About where the camera is now, for one that is lost."""
        guess = guess_to_proto(T_world_camera)
        await self._exchange.send(localization_pb2.TrackPosesRequest(guess=guess))

    async def finish(self) -> None:
        """Say that no events follow."""
        await self._exchange.finish()

    async def receive(self) -> TrackedPose | None:
        """The next pose; None after the last."""
        answer = await self._exchange.receive()
        return None if answer is None else tracked_pose_from_proto(answer)


class AsyncOperation:
    """Work on a server.

    Attributes:
        name: `operations/{uuid}`.
    """

    def __init__(self, connection: AsyncConnection, name: str) -> None:
        self.name = name
        self._connection = connection
        self._operations = operations_pb2_grpc.OperationsStub(connection.channel)
        self._watching = roel_operations_pb2_grpc.OperationServiceStub(connection.channel)
        self._update_seq = 0

    async def wait(self, progress: ProgressCallback = ignore) -> Any:
        """What the operation answers with; whatever interrupts the waiting cancels it.

        Returns:
            The `response_type` that the protocol names: of a build the version.

        Raises:
            RoelError: why the operation failed.
            Cancelled: it was cancelled.
        """
        try:
            operation = await _resumed(lambda: self._watch(progress))
        except BaseException:
            with contextlib.suppress(RoelError):
                await self.cancel()
            raise
        if operation.HasField("error"):
            raise error_from_status(operation.error)
        answer = ANSWERS[operation.response.TypeName()]()
        operation.response.Unpack(answer)
        return answer

    async def is_done(self) -> bool:
        """Whether the operation has ended, well or not."""
        request = operations_pb2.GetOperationRequest(name=self.name)
        return bool((await self._connection.call(self._operations.GetOperation, request)).done)

    async def cancel(self) -> None:
        """End the work; returns when it has ended."""
        request = operations_pb2.CancelOperationRequest(name=self.name)
        await self._connection.call(self._operations.CancelOperation, request)

    async def _watch(self, progress: ProgressCallback) -> operations_pb2.Operation:
        """Tell every change from the last one seen; the operation when it is done."""
        request = roel_operations_pb2.WatchOperationRequest(
            name=self.name, update_seq=self._update_seq
        )
        answers = self._connection.stream(self._watching.WatchOperation, request)
        async with contextlib.aclosing(answers):
            async for answer in answers:
                self._update_seq = answer.update_seq
                if answer.operation.done:
                    return answer.operation
                metadata = roel_operations_pb2.OperationMetadata()
                answer.operation.metadata.Unpack(metadata)
                progress(progress_from_proto(metadata))
        raise RoelError(self.name, "an operation that ends", "a watch that ended before it")


def _pose_requests(stream: str, trajectory: Trajectory) -> Iterator[events_pb2.AppendPosesRequest]:
    yield events_pb2.AppendPosesRequest(event_stream=stream)
    columns = trajectory_to_proto(trajectory)
    for start in range(0, len(trajectory), POSES_PER_MESSAGE):
        yield events_pb2.AppendPosesRequest(poses=_pose_part(columns, start))


def _pose_part(columns: types_pb2.Trajectory, start: int) -> types_pb2.Trajectory:
    """Rows start to start + `POSES_PER_MESSAGE` of every column."""
    rows = slice(start, start + POSES_PER_MESSAGE)
    return types_pb2.Trajectory(
        t_us=columns.t_us[rows.start * 8 : rows.stop * 8],
        translation_m=columns.translation_m[rows.start * 24 : rows.stop * 24],
        rotation=columns.rotation[rows.start * 72 : rows.stop * 72],
    )


async def _resumed(
    call: Callable[[], Awaitable[Result]], position: Callable[[], int] = lambda: 0
) -> Result:
    """Result of a call that continues where it broke.

    Args:
        position: how far the calls came; the pauses begin anew when that was further than before.

    Raises:
        UnavailableError: the server stayed unavailable.
    """
    attempts, reached = Attempts(RESUMING), position()
    while True:
        try:
            return await call()
        except RoelError as error:
            if position() > reached:
                attempts, reached = Attempts(RESUMING), position()
            await asyncio.sleep(attempts.pause_s(error))


def _temporary_id() -> str:
    return f"temporary-{uuid.uuid4().hex[:16]}"
