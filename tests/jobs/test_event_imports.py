import hashlib

import numpy as np
import pytest

from roel_service.errors import EventsError, LimitError
from roel_service.io.events import write_events_hdf5
from roel_service.jobs.event_imports import EventImportParameters, run_event_import
from roel_service.wire.chunks import MAX_CHUNK_EVENT_COUNT, decode_chunk

from ..service.processes import CAMERA, events_of


@pytest.fixture
def run(tmp_path):
    def run(file, told=None, max_size_bytes=1 << 20, width=CAMERA.width):
        parameters = EventImportParameters(
            file=file,
            width=width,
            height=CAMERA.height,
            target=tmp_path / "chunks",
            max_size_bytes=max_size_bytes,
            fence=7,
        )
        return run_event_import(parameters, (told if told is not None else []).append)

    return run


def test_a_file_becomes_chunks(tmp_path, run):
    events = events_of(MAX_CHUNK_EVENT_COUNT + 10)
    write_events_hdf5(tmp_path / "events.h5", [events])
    told = []
    outcome = run(tmp_path / "events.h5", told)
    assert outcome.fence == 7
    data = outcome.file.read_bytes()
    decoded = []
    for facts in outcome.chunks:
        part, data = data[: facts.length], data[facts.length :]
        assert hashlib.sha256(part).hexdigest() == facts.sha256
        decoded.append(decode_chunk(part, previous_t1_us=None))
        assert (facts.t0_us, facts.t1_us) == (decoded[-1].t_us[0], decoded[-1].t_us[-1])
    assert data == b""
    assert [facts.event_count for facts in outcome.chunks] == [MAX_CHUNK_EVENT_COUNT, 10]
    np.testing.assert_array_equal(np.concatenate([part.t_us for part in decoded]), events.t_us)
    assert [(item.done_count, item.total_count) for item in told] == [
        (MAX_CHUNK_EVENT_COUNT, len(events)),
        (len(events), len(events)),
    ]
    assert told[-1].fraction == 1.0


def test_what_is_no_recording_of_this_sensor_is_refused(tmp_path, run):
    file = tmp_path / "file"
    file.write_bytes(b"\xff\xfehello")
    with pytest.raises(EventsError, match="imported file"):
        run(file)
    file.write_text("0.1 63 3 1\n")
    with pytest.raises(EventsError) as caught:
        run(file, width=63)
    assert caught.value.reason == "EVENT_OUT_OF_BOUNDS"


def test_a_file_of_too_many_events_is_refused(tmp_path, run):
    file = tmp_path / "file"
    file.write_text("0.1 6 3 1\n0.2 5 5 0\n")
    with pytest.raises(LimitError) as caught:
        run(file, max_size_bytes=10)
    assert caught.value.reason == "EVENT_STREAM_TOO_LARGE"
