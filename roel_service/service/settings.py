"""What the operator of a server decides; the limits are told by GetCapabilities."""

from __future__ import annotations

from dataclasses import dataclass

from roel_service.pano_loc.hints import MAX_MAP_COUNT
from roel_service.service.paging import MAX_PAGE_SIZE
from roel_service.store import retention
from roel_service.store.garbage import LONGEST_UPLOAD_S
from roel_service.wire.chunks import MAX_CHUNK_EVENT_COUNT
from roel_service.wire.rlm import MAX_LINE_COUNT

MIB = 2**20
GIB = 2**30


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Limits and times of one server.

    Attributes:
        message_in_bytes, message_out_bytes: largest request and answer.
        event_stream_bytes: largest recording, compressed.
        pose_count: most poses of a recording.
        concurrent_builds: children at a time.
        queued_builds: builds that may wait for a child.
        task_memory_bytes, retried_task_memory_bytes: resident memory of a child, and of one that
            tries again what needed more.
        task_time_s: wall clock of one attempt.
        retry_delay_s: mean time before a lost or broken attempt is tried again; it doubles.
        append_credit_chunks: event chunks of a call that may be under way at a time.
        preview_event_count: most events of a picture; they are counted in the front.
        blob_bytes, blob_part_bytes: largest blob that is uploaded, and part of it.
        blob_credit_bytes: bytes of a call that may be under way.
        open_uploads: uploads at a time.
        upload_silence_s: an upload that sends nothing for this long is ended.
        commit_interval_s, commit_bytes: what an upload sent is made durable when its first part is
            this old, or when it is this much.
        stage_cache_bytes: kept of the results of stages, for builds that differ only in later ones.
        follow_patience_s: an upload that a build follows may stand still for so long.
        sweep_interval_s: time between two collections of garbage.
        longest_upload_s: files that nobody names are no garbage before.
        download_part_bytes: size of the messages of a download.
        lines_per_message: most lines of a message of GetLines.
        label_count: most labels of a resource.
        display_name_length: most characters of a display name.
        alias_count: most aliases of a map.
        calls_in_flight: calls of one method at a time.
        calls_waiting: calls of one method that may wait for their turn.
        calls_unseen: calls that may have arrived without having been looked at; beyond, gRPC drops
            them.
        interactive_workers: children that answer callers who wait; all methods share them.
        interactive_queued: such questions that may wait for a child.
        interactive_time_s: how long an answer may take.
        tracked_cameras: cameras that are followed at a time; each holds a child for itself.
        open_streams: streams of pictures or events that are located at a time.
        stream_credit_pictures: pictures of a stream that may be unanswered.
        batch_item_count: most requests of a batch.
        batch_item_time_s: what a request may add to the time of its batch.
        inline_point_count: most points of a cloud that comes in a request.
        export_time_s: how long a version may take to be written in another format.
        concurrent_exports, queued_exports: such versions at a time, and those that may wait.
        drain_grace_s: how long calls other than uploads may go on after SIGTERM.
        build_entrypoint: `module:function` of a build, imported in the child alone.
    """

    message_in_bytes: int = 4 * MIB
    message_out_bytes: int = 8 * MIB
    event_stream_bytes: int = 10 * GIB
    pose_count: int = 1_000_000
    concurrent_builds: int = 2
    queued_builds: int = 16
    task_memory_bytes: int = 2 * GIB
    retried_task_memory_bytes: int = 4 * GIB
    task_time_s: float = 3600.0
    retry_delay_s: float = 1.0
    append_credit_chunks: int = 16
    preview_event_count: int = 1_000_000
    blob_bytes: int = 10 * GIB
    blob_part_bytes: int = MIB
    blob_credit_bytes: int = 8 * MIB
    open_uploads: int = 64
    upload_silence_s: float = 60.0
    commit_interval_s: float = 0.02
    stage_cache_bytes: int = 2 * GIB
    follow_patience_s: float = 600.0
    sweep_interval_s: float = 3600.0
    longest_upload_s: float = LONGEST_UPLOAD_S
    commit_bytes: int = 8 * MIB
    download_part_bytes: int = MIB
    lines_per_message: int = 100_000
    label_count: int = 64
    display_name_length: int = 200
    alias_count: int = 64
    calls_in_flight: int = 32
    calls_waiting: int = 128
    calls_unseen: int = 128
    interactive_workers: int = 2
    interactive_queued: int = 8
    interactive_time_s: float = 120.0
    batch_item_count: int = 100_000
    batch_item_time_s: float = 10.0
    inline_point_count: int = 250_000
    tracked_cameras: int = 2
    open_streams: int = 32
    stream_credit_pictures: int = 4
    export_time_s: float = 300.0
    concurrent_exports: int = 1
    queued_exports: int = 8
    drain_grace_s: float = 2.0
    build_entrypoint: str = "roel_service.jobs.build:run_build"

    @property
    def events_per_chunk(self) -> int:
        """Most events of a chunk; the format decides."""
        return MAX_CHUNK_EVENT_COUNT

    @property
    def line_count(self) -> int:
        """Most lines of a map; the format decides."""
        return MAX_LINE_COUNT

    @property
    def maps_per_picture(self) -> int:
        """Most versions that one picture is looked for in; the search decides."""
        return MAX_MAP_COUNT

    @property
    def page_size(self) -> int:
        """Most items of a page."""
        return MAX_PAGE_SIZE

    @property
    def operation_retention_days(self) -> int:
        """How long an ended operation is remembered."""
        return retention.OPERATION_RETENTION_DAYS

    @property
    def request_retention_days(self) -> int:
        """How long a request id is remembered."""
        return retention.REQUEST_RETENTION_DAYS

    @property
    def deleted_map_retention_days(self) -> int:
        """How long a deleted map can be undeleted."""
        return retention.DELETED_MAP_RETENTION_DAYS
