"""What builds answer, as messages; the report has the keys that `roel map build` prints."""

from __future__ import annotations

from typing import Any

from roel_service.progress import Progress
from roel_service.scene.results import MAPPING_STAGES
from roel_service.v1 import maps_pb2, operations_pb2
from roel_service.wire.configs import tables_from_proto, tables_to_proto

Report = dict[str, Any]

_NUMBERS = ("frame_count", "event_count", "line_count", "seconds_total", "peak_rss_mib")


def report_to_proto(report: Report) -> maps_pb2.BuildReport:
    """Every key of the report."""
    return maps_pb2.BuildReport(
        **{key: report[key] for key in _NUMBERS},
        seconds=report["seconds"],
        config=tables_to_proto(report["config"]),
        versions=report["versions"],
    )


def report_from_proto(message: maps_pb2.BuildReport) -> Report:
    """The report with its keys in the order of the command line's contract."""
    return {
        "frame_count": message.frame_count,
        "event_count": message.event_count,
        "line_count": message.line_count,
        "seconds": {stage: message.seconds[stage] for stage in MAPPING_STAGES},
        "seconds_total": message.seconds_total,
        "peak_rss_mib": message.peak_rss_mib,
        "config": tables_from_proto(message.config),
        "versions": dict(sorted(message.versions.items())),
    }


def progress_from_proto(message: operations_pb2.OperationMetadata) -> Progress:
    """How far an operation is."""
    return Progress(
        stage=message.stage,
        done_count=message.done_count,
        total_count=message.total_count,
        fraction=message.fraction,
    )
