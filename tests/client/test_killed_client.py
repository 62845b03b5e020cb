"""A client process that dies in the middle of an upload, and the next one."""

import subprocess
import sys

from ..service.processes import CAMERA, new_id, wait_until
from . import uploading


def uploading_process(server, stream, chunk_count):
    command = [sys.executable, uploading.__file__, server.address, stream, str(chunk_count)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


def test_what_a_killed_client_got_acknowledged_is_not_sent_again(server, client):
    stream, whole = (client.create_event_stream(new_id(), CAMERA) for _ in range(2))
    # It waits for its eleventh chunk when it dies; the encoders read at most eight ahead.
    with uploading_process(server, stream, 10) as first:
        try:
            wait_until(lambda: client.event_stream(stream).chunk_count >= 2)
        finally:
            first.kill()
        sent = [int(line) for line in first.stdout]
    acknowledged_count = client.event_stream(stream).chunk_count
    assert sent == list(range(len(sent)))
    assert 2 <= acknowledged_count <= len(sent) < uploading.CHUNK_COUNT
    with uploading_process(server, stream, uploading.CHUNK_COUNT) as second:
        sent = [int(line) for line in second.stdout]
        assert second.wait() == 0
    assert sent[0] >= acknowledged_count
    assert sent == list(range(sent[0], uploading.CHUNK_COUNT))
    client.upload_events(whole, uploading.recording())
    assert client.finalize(stream).digest == client.finalize(whole).digest
