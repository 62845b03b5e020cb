import json

from roel_service.config.load import to_tables
from roel_service.config.presets import PRESETS, preset
from roel_service.progress import Progress
from roel_service.scene.results import MAPPING_STAGES
from roel_service.v1 import operations_pb2
from roel_service.wire.results import progress_from_proto, report_from_proto, report_to_proto


def report_of(name):
    return {
        "frame_count": 30,
        "event_count": 10**10,
        "line_count": 7,
        "seconds": {stage: 0.1 * index for index, stage in enumerate(MAPPING_STAGES)},
        "seconds_total": 12.25,
        "peak_rss_mib": 512.5,
        "config": to_tables(preset(name)),
        "versions": {"python": "3.11", "roel_service": "0.1.0"},
    }


def test_reports_print_the_same_json_on_both_sides():
    for name in PRESETS:
        report = report_of(name)
        restored = report_from_proto(report_to_proto(report))
        assert json.dumps(restored) == json.dumps(report)


def test_progress_is_what_the_metadata_says():
    message = operations_pb2.OperationMetadata(
        stage="refine", done_count=2, total_count=8, fraction=0.5
    )
    expected = Progress(stage="refine", done_count=2, total_count=8, fraction=0.5)
    assert progress_from_proto(message) == expected
