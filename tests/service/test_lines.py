"""Lines in and out: ImportMap, ExportMap, GetLines, SyncBlocks."""

import hashlib
import uuid

import numpy as np
import pytest

from roel_service.errors import InputError, MapFileError, NotFoundError
from roel_service.io.maps import export_map
from roel_service.scene.lines import LineMap
from roel_service.v1 import maps_pb2, maps_pb2_grpc, types_pb2
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import BLOCK_LINE_COUNT, decode_map, encode_map

from .processes import new_id

COUNT = BLOCK_LINE_COUNT + 100


def many_lines(seed=0):
    rng = np.random.default_rng(seed)
    start = rng.uniform(0, 8, (COUNT, 1, 3))
    return LineMap(
        segments=start
        + np.concatenate([np.zeros((COUNT, 1, 3)), rng.normal(0, 0.5, (COUNT, 1, 3))], 1),
        observation_count=rng.integers(0, 50, COUNT).astype(np.int32),
        rms_residual_px=rng.uniform(0.1, 1, COUNT).astype(np.float32),
        sigma_m=rng.uniform(0.01, 0.1, COUNT).astype(np.float32),
    )


RLM = encode_map(many_lines(), Provenance(config_digest="sha256:ab"))
LINES = decode_map(RLM).line_map


@pytest.fixture(scope="module")
def stub(connection):
    return maps_pb2_grpc.MapServiceStub(connection.channel)


@pytest.fixture
def send(client, connection, stub):
    """Imports bytes into a new map; the operation."""

    def sent(data, **fields):
        request = maps_pb2.ImportMapRequest(parent=client.create_map(new_id()), data=data, **fields)
        return client.operation(connection.call(stub.ImportMap, request).name)

    return sent


@pytest.fixture(scope="module")
def version(client, connection, stub):
    """A version of two blocks."""
    request = maps_pb2.ImportMapRequest(parent=client.create_map(new_id()), data=RLM)
    return client.operation(connection.call(stub.ImportMap, request).name).wait()


@pytest.fixture
def lines(connection, stub, version):
    """Columns of all messages of GetLines."""

    def asked(name=version.name, **fields):
        request = maps_pb2.GetLinesRequest(name=name, **fields)
        messages = list(connection.stream(stub.GetLines, request))
        assert {message.map_version for message in messages} == {version.name}
        columns = (
            ("segments_m", "<f8"),
            ("observation_count", "<i4"),
            ("rms_residual_px", "<f4"),
            ("sigma_m", "<f4"),
        )
        joined = [
            np.frombuffer(b"".join(getattr(message, name) for message in messages), dtype)
            for name, dtype in columns
        ]
        return joined[0].reshape(-1, 2, 3), *joined[1:], len(messages)

    return asked


def test_an_imported_map_file_is_kept_byte_for_byte(client, version):
    assert client.download_map(version.name) == RLM
    assert version.imported_file.format == "rlm"
    assert version.imported_file.blob.sha256 == hashlib.sha256(RLM).hexdigest()
    assert version.provenance.config_digest == "sha256:ab"
    assert (version.line_count, version.event_stream) == (COUNT, "")
    assert not version.HasField("report")


def test_lines_of_other_programs_are_imported(send):
    made = send(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nl 1 2 3 1\nl 1 1\n").wait()
    assert (made.line_count, made.imported_file.format) == (3, "obj")
    assert made.imported_file.dropped_line_count == 1


def test_a_file_that_is_no_map_fails_its_operation(client, send):
    operation = send(b"hello")
    with pytest.raises(MapFileError, match="imported file") as caught:
        operation.wait()
    assert caught.value.reason == "MAP_FILE_INVALID"


def test_an_import_needs_a_source_that_exists(client, connection, stub):
    parent = client.create_map(new_id())
    with pytest.raises(InputError, match="data or blob"):
        connection.call(stub.ImportMap, maps_pb2.ImportMapRequest(parent=parent))
    blob = types_pb2.BlobRef(sha256="0" * 64, size_bytes=1)
    with pytest.raises(NotFoundError, match="blob"):
        connection.call(stub.ImportMap, maps_pb2.ImportMapRequest(parent=parent, blob=blob))
    blob.sha256 = "../../rows.sqlite"
    with pytest.raises(InputError, match="sha256"):
        connection.call(stub.ImportMap, maps_pb2.ImportMapRequest(parent=parent, blob=blob))


def test_the_same_import_twice_is_one_operation(client, connection, stub):
    parent = client.create_map(new_id())
    request = maps_pb2.ImportMapRequest(parent=parent, data=RLM, request_id=str(uuid.uuid4()))
    first = connection.call(stub.ImportMap, request)
    client.operation(first.name).wait()
    again = connection.call(stub.ImportMap, request)
    assert (again.name, again.done) == (first.name, True)
    request.data = RLM[:-1]
    with pytest.raises(InputError) as caught:
        connection.call(stub.ImportMap, request)
    assert caught.value.reason == "REQUEST_ID_REUSED"
    listed = connection.call(stub.ListMapVersions, maps_pb2.ListMapVersionsRequest(parent=parent))
    assert len(listed.map_versions) == 1


@pytest.mark.parametrize("name", ["npz", "csv"])
def test_an_export_is_the_file_that_the_command_line_writes(
    connection, stub, version, tmp_path, name
):
    number = maps_pb2.MapFormat.Value(f"MAP_FORMAT_{name.upper()}")
    request = maps_pb2.ExportMapRequest(name=latest(version), format=number)
    first, *rest = connection.stream(stub.ExportMap, request)
    data = b"".join(part.data for part in rest)
    assert (first.map_version, first.size_bytes) == (version.name, len(data))
    export_map(LINES, tmp_path / f"map.{name}")
    assert data == (tmp_path / f"map.{name}").read_bytes()


def test_an_unknown_format_is_refused(connection, stub, version):
    request = maps_pb2.ExportMapRequest(name=version.name, format=99)
    with pytest.raises(InputError, match="format: expected one of rlm, npz"):
        list(connection.stream(stub.ExportMap, request))


def latest(version):
    return version.name.replace("/versions/v1", "/versions/latest")


def test_all_lines_come_in_the_order_of_the_file(lines, version):
    segments, counts, residuals, sigmas, message_count = lines(latest(version))
    assert np.array_equal(segments, LINES.segments)
    assert np.array_equal(counts, LINES.observation_count)
    assert np.array_equal(residuals, LINES.rms_residual_px)
    assert np.array_equal(sigmas, LINES.sigma_m)
    assert message_count == 1


def test_lines_are_chosen_by_place_length_and_observations(lines):
    box = types_pb2.Bounds(min_x_m=1, min_y_m=1, min_z_m=1, max_x_m=4, max_y_m=4, max_z_m=4)
    segments, counts, *_ = lines(bounds=box, min_length_m=0.5, min_observation_count=20)
    inside = ((LINES.segments >= 1) & (LINES.segments <= 4)).all(axis=2).any(axis=1)
    wanted = inside & (LINES.lengths_m >= 0.5) & (LINES.observation_count >= 20)
    assert 0 < wanted.sum() <= len(segments) < COUNT / 4
    found = {segment.tobytes() for segment in segments}
    assert {segment.tobytes() for segment in LINES.segments[wanted]} <= found
    assert counts.min() >= 20
    assert np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1).min() >= 0.5


def test_a_region_without_lines_is_an_answer(lines):
    far = types_pb2.Bounds(min_x_m=90, max_x_m=91, max_y_m=1, max_z_m=1)
    segments, *_, message_count = lines(bounds=far)
    assert (len(segments), message_count) == (0, 1)


@pytest.mark.parametrize(
    ("fields", "subject"),
    [
        ({"bounds": types_pb2.Bounds(min_x_m=2, max_x_m=1)}, "bounds"),
        ({"bounds": types_pb2.Bounds(max_x_m=np.inf)}, "bounds"),
        ({"min_length_m": -1}, "min_length_m"),
        ({"min_length_m": np.nan}, "min_length_m"),
    ],
)
def test_conditions_that_cannot_be_are_refused(lines, fields, subject):
    with pytest.raises(InputError) as caught:
        lines(**fields)
    assert caught.value.subject == subject


def test_a_client_gets_the_blocks_that_it_does_not_hold(connection, stub, version):
    def sync(held):
        request = maps_pb2.SyncBlocksRequest(name=latest(version), held_block_sha256=held)
        return connection.call(stub.SyncBlocks, request)

    whole = sync([])
    assert whole.map_version == version.name
    assert whole.head + b"".join(whole.blocks) + whole.tail == RLM
    digests = list(whole.block_sha256)
    assert digests == [hashlib.sha256(block).digest() for block in whole.blocks]
    rest = sync(digests[:1])
    assert list(rest.blocks) == list(whole.blocks)[1:]
    assert list(rest.block_sha256) == digests
    assert not sync(digests).blocks
