"""The synchronous client: recordings up, maps down."""

from __future__ import annotations

import contextlib
import hashlib
import uuid
from collections.abc import Iterator
from types import TracebackType

from google.longrunning import operations_pb2, operations_pb2_grpc

from roel_client.connection import Connection
from roel_client.retry import resumed
from roel_service.config.stages import Config
from roel_service.errors import CorruptionError, RoelError
from roel_service.progress import Progress, ProgressCallback, ignore
from roel_service.scene.camera import Camera
from roel_service.scene.events import EventSource
from roel_service.scene.trajectory import Trajectory
from roel_service.v1 import (
    capabilities_pb2,
    capabilities_pb2_grpc,
    events_pb2,
    events_pb2_grpc,
    maps_pb2,
    maps_pb2_grpc,
    types_pb2,
)
from roel_service.v1 import operations_pb2 as roel_operations_pb2
from roel_service.v1 import operations_pb2_grpc as roel_operations_pb2_grpc
from roel_service.wire import names
from roel_service.wire.chunks import encode_chunk, split_chunks
from roel_service.wire.configs import config_to_proto
from roel_service.wire.errors import error_from_status
from roel_service.wire.nouns import camera_to_proto, trajectory_to_proto
from roel_service.wire.results import Report, progress_from_proto, report_from_proto

# Sealing a recording reads it once.
FINALIZE_TIMEOUT_S = 300.0

# About 0.8 MiB a message.
POSES_PER_MESSAGE = 8192


class Client:
    """One server; a context manager.

    Every method raises the `RoelError` that the server raised, and `UnavailableError` when there
    is no server.

    Args:
        address: `HOST:PORT`.
    """

    def __init__(self, address: str) -> None:
        self._connection = Connection(address)
        channel = self._connection.channel
        self._capabilities = capabilities_pb2_grpc.CapabilitiesServiceStub(channel)
        self._streams = events_pb2_grpc.EventStreamServiceStub(channel)
        self._maps = maps_pb2_grpc.MapServiceStub(channel)

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End the connection."""
        self._connection.close()

    def capabilities(self) -> capabilities_pb2.Capabilities:
        """Version, limits, presets and stages of the server."""
        request = capabilities_pb2.GetCapabilitiesRequest()
        return self._connection.call(self._capabilities.GetCapabilities, request)

    def map_recording(
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
        with self._temporary_stream(camera) as stream, self._temporary_map() as map_name:
            self.upload_poses(stream, trajectory)
            self.upload_events(stream, events, progress)
            self.finalize(stream)
            version = self.build_map(map_name, stream, config).wait(progress)
            return self.download_map(version.name), report_from_proto(version.report)

    def create_event_stream(self, stream_id: str, camera: Camera) -> str:
        """Open a recording; its name."""
        request = events_pb2.CreateEventStreamRequest(
            parent=names.PROJECT,
            event_stream_id=stream_id,
            event_stream=events_pb2.EventStream(camera=camera_to_proto(camera)),
        )
        return str(self._connection.call(self._streams.CreateEventStream, request).name)

    def upload_events(
        self, stream: str, source: EventSource, progress: ProgressCallback = ignore
    ) -> events_pb2.EventStream:
        """Append a whole source; a broken upload is taken up where the server's record ends."""
        return resumed(lambda: self._append_events(stream, source, progress))

    def upload_poses(self, stream: str, trajectory: Trajectory) -> events_pb2.EventStream:
        """Append poses."""
        requests = _pose_requests(stream, trajectory)
        return self._connection.upload(self._streams.AppendPoses, requests)

    def finalize(self, stream: str) -> events_pb2.EventStream:
        """Freeze a recording."""
        request = events_pb2.FinalizeEventStreamRequest(name=stream)
        method = self._streams.FinalizeEventStream
        return self._connection.call(method, request, timeout_s=FINALIZE_TIMEOUT_S)

    def event_stream(self, name: str) -> events_pb2.EventStream:
        """What the server has of a recording."""
        request = events_pb2.GetEventStreamRequest(name=name)
        return self._connection.call(self._streams.GetEventStream, request)

    def delete_event_stream(self, name: str) -> None:
        """Delete a recording."""
        request = events_pb2.DeleteEventStreamRequest(name=name)
        self._connection.call(self._streams.DeleteEventStream, request)

    def create_map(self, map_id: str) -> str:
        """Name a map; its resource name."""
        request = maps_pb2.CreateMapRequest(parent=names.PROJECT, map_id=map_id)
        return str(self._connection.call(self._maps.CreateMap, request).name)

    def build_map(self, map_name: str, stream: str, config: Config) -> Operation:
        """Begin to build a new version of a map from a frozen recording."""
        request = maps_pb2.BuildMapRequest(
            parent=map_name, event_stream=stream, config=config_to_proto(config)
        )
        return self.operation(self._connection.call(self._maps.BuildMap, request).name)

    def operation(self, name: str) -> Operation:
        """A build that was begun before, perhaps by somebody else."""
        return Operation(self._connection, name)

    def map_version(self, name: str) -> maps_pb2.MapVersion:
        """One version of a map; its last part may be `latest`."""
        request = maps_pb2.GetMapVersionRequest(name=name)
        return self._connection.call(self._maps.GetMapVersion, request)

    def download_map(self, name: str) -> bytes:
        """The map file of a version; raises `CorruptionError` unless it is what was built."""
        version = self.map_version(name)
        request = maps_pb2.DownloadMapRequest(name=version.name)
        parts = self._connection.stream(self._maps.DownloadMap, request)
        data = b"".join(part.data for part in parts)
        found = hashlib.sha256(data).hexdigest()
        if found != version.map.sha256:
            raise CorruptionError(version.name, f"bytes of digest {version.map.sha256}", found)
        return data

    def delete_map(self, name: str) -> None:
        """Delete a map with all its versions."""
        self._connection.call(self._maps.DeleteMap, maps_pb2.DeleteMapRequest(name=name))

    def _append_events(
        self, stream: str, source: EventSource, progress: ProgressCallback
    ) -> events_pb2.EventStream:
        first_seq = self.event_stream(stream).chunk_count
        requests = _event_requests(stream, source, first_seq, progress)
        return self._connection.upload(self._streams.AppendEvents, requests)

    @contextlib.contextmanager
    def _temporary_stream(self, camera: Camera) -> Iterator[str]:
        name = self.create_event_stream(_temporary_id(), camera)
        try:
            yield name
        finally:
            with contextlib.suppress(RoelError):
                self.delete_event_stream(name)

    @contextlib.contextmanager
    def _temporary_map(self) -> Iterator[str]:
        name = self.create_map(_temporary_id())
        try:
            yield name
        finally:
            with contextlib.suppress(RoelError):
                self.delete_map(name)


class Operation:
    """A build on a server.

    Attributes:
        name: `operations/{uuid}`.
    """

    def __init__(self, connection: Connection, name: str) -> None:
        self.name = name
        self._connection = connection
        self._operations = operations_pb2_grpc.OperationsStub(connection.channel)
        self._watching = roel_operations_pb2_grpc.OperationServiceStub(connection.channel)
        self._update_seq = 0

    def wait(self, progress: ProgressCallback = ignore) -> maps_pb2.MapVersion:
        """The version that was built; whatever interrupts the waiting cancels the build.

        Raises:
            RoelError: why the build failed.
            Cancelled: it was cancelled.
        """
        try:
            operation = resumed(lambda: self._watch(progress))
        except BaseException:
            with contextlib.suppress(RoelError):
                self.cancel()
            raise
        if operation.HasField("error"):
            raise error_from_status(operation.error)
        version = maps_pb2.MapVersion()
        operation.response.Unpack(version)
        return version

    def cancel(self) -> None:
        """End the build; returns when it has ended."""
        request = operations_pb2.CancelOperationRequest(name=self.name)
        self._connection.call(self._operations.CancelOperation, request)

    def _watch(self, progress: ProgressCallback) -> operations_pb2.Operation:
        """Tell every change from the last one seen; the operation when it is done."""
        request = roel_operations_pb2.WatchOperationRequest(
            name=self.name, update_seq=self._update_seq
        )
        answers = self._connection.stream(self._watching.WatchOperation, request)
        with contextlib.closing(answers):
            for answer in answers:
                self._update_seq = answer.update_seq
                if answer.operation.done:
                    return answer.operation
                metadata = roel_operations_pb2.OperationMetadata()
                answer.operation.metadata.Unpack(metadata)
                progress(progress_from_proto(metadata))
        raise RoelError(self.name, "an operation that ends", "a watch that ended before it")


def _event_requests(
    stream: str, source: EventSource, first_seq: int, progress: ProgressCallback
) -> Iterator[events_pb2.AppendEventsRequest]:
    yield events_pb2.AppendEventsRequest(event_stream=stream)
    event_count = 0
    for seq, events in enumerate(split_chunks(source)):
        event_count += len(events)
        if seq >= first_seq:
            chunk = events_pb2.EventChunk(seq=seq, data=encode_chunk(events))
            yield events_pb2.AppendEventsRequest(chunk=chunk)
        told = Progress(stage="upload", done_count=event_count, total_count=0, fraction=0.0)
        progress(told)


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


def _temporary_id() -> str:
    return f"temporary-{uuid.uuid4().hex[:16]}"
