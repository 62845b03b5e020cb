import numpy as np
import pytest

from roel_service.scene.lines import LineMap
from roel_service.service.line_streams import conditions_from_proto, line_messages
from roel_service.v1 import maps_pb2
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import BLOCK_LINE_COUNT, MapBlocks, decode_map, encode_map

COUNT = 2 * BLOCK_LINE_COUNT + 10


@pytest.fixture(scope="module")
def data():
    rng = np.random.default_rng(0)
    segments = rng.uniform(0, 8, (COUNT, 2, 3))
    return encode_map(LineMap.from_segments(segments), Provenance())


@pytest.mark.parametrize("max_line_count", [1000, BLOCK_LINE_COUNT, COUNT - 1, COUNT])
def test_no_message_holds_more_lines_than_it_may(data, max_line_count):
    conditions = conditions_from_proto(maps_pb2.GetLinesRequest())
    messages = list(line_messages(MapBlocks(data), conditions, "v1", max_line_count))
    parts = [np.frombuffer(message.segments_m).reshape(-1, 2, 3) for message in messages]
    assert max(len(part) for part in parts) <= max_line_count
    assert len(parts) == -(-COUNT // max_line_count)
    assert np.array_equal(np.concatenate(parts), decode_map(data).line_map.segments)


def test_blocks_beyond_the_box_are_not_decoded(data, monkeypatch):
    decoded = []
    blocks = MapBlocks(data)
    monkeypatch.setattr(blocks, "lines", decoded.append)
    request = maps_pb2.GetLinesRequest()
    request.bounds.min_x_m = request.bounds.max_x_m = 20
    messages = list(line_messages(blocks, conditions_from_proto(request), "v1", 100))
    assert decoded == []
    assert [message.segments_m for message in messages] == [b""]
