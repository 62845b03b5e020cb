import hashlib
import zlib

import pytest

from roel_service.errors import (
    ConflictError,
    InputError,
    LimitError,
    NotFoundError,
    StateError,
)
from roel_service.v1 import blobs_pb2, blobs_pb2_grpc, types_pb2

from .processes import new_id

PARENT = "projects/default"


@pytest.fixture(scope="module")
def stub(connection):
    return blobs_pb2_grpc.BlobServiceStub(connection.channel)


@pytest.fixture
def write(connection, stub):
    """All answers of a call of WriteBlob."""
    return lambda *requests: list(connection.stream(stub.WriteBlob, iter(requests)))


@pytest.fixture
def read(connection, stub):
    def read(sha256, **fields):
        request = blobs_pb2.ReadBlobRequest(name=f"{PARENT}/blobs/{sha256}", **fields)
        return b"".join(part.data for part in connection.stream(stub.ReadBlob, request))

    return read


def digest(data):
    return hashlib.sha256(data).hexdigest()


def header(data, upload_id, **fields):
    blob = types_pb2.BlobRef(sha256=digest(data), size_bytes=len(data))
    message = {"parent": PARENT, "blob": blob, "upload_id": upload_id, **fields}
    return blobs_pb2.WriteBlobRequest(header=blobs_pb2.WriteBlobHeader(**message))


def part(data, offset=0, crc32=None):
    checked = zlib.crc32(data) if crc32 is None else crc32
    message = blobs_pb2.BlobPart(offset=offset, data=data, crc32=checked)
    return blobs_pb2.WriteBlobRequest(data=message)


FINISH = blobs_pb2.WriteBlobRequest(finish=blobs_pb2.WriteBlobFinish())


def test_a_file_comes_back_as_it_went(client, tmp_path):
    data = bytes(range(256)) * 12_000  # three parts
    source, target = tmp_path / "source", tmp_path / "target"
    source.write_bytes(data)
    told = []
    blob = client.upload_blob(source, told.append)
    assert (blob.sha256, blob.size_bytes) == (digest(data), len(data))
    assert told[0].done_count == 0
    assert (told[-1].done_count, told[-1].fraction) == (len(data), 1.0)
    client.download_blob(blob.sha256, target)
    assert target.read_bytes() == data
    assert sorted(path.name for path in tmp_path.iterdir()) == ["source", "target"]


def test_a_blob_that_exists_is_not_sent_again(connection, stub, write):
    data = b"twice"
    assert write(header(data, new_id()), part(data), FINISH)[-1].blob.sha256 == digest(data)
    assert [status.committed_bytes for status in write(header(data, new_id()))] == [5]
    request = blobs_pb2.FindMissingBlobsRequest(
        parent=PARENT, sha256=[digest(b"never"), digest(data)]
    )
    answer = connection.call(stub.FindMissingBlobs, request)
    assert list(answer.missing_sha256) == [digest(b"never")]


def test_an_upload_goes_on_where_it_broke(connection, stub, write):
    upload_id, data = new_id(), b"broken in the middle"
    assert write(header(data, upload_id), part(data[:6]))[-1].committed_bytes == 6
    request = blobs_pb2.QueryWriteStatusRequest(parent=PARENT, upload_id=upload_id)
    status = connection.call(stub.QueryWriteStatus, request)
    assert (status.committed_bytes, status.credit_bytes) == (6, 8 << 20)
    statuses = write(header(data, upload_id), part(data[6:], 6), FINISH)
    assert statuses[0].committed_bytes == 6
    assert statuses[-1].blob.size_bytes == len(data)


def test_a_second_writer_takes_over(connection, stub, write):
    upload_id, data = new_id(), b"two writers"
    with connection.exchange(stub.WriteBlob) as first:
        first.send(header(data, upload_id))
        first.receive()
        write(header(data, upload_id), part(data))
        with pytest.raises(ConflictError) as caught:
            first.receive()
    assert caught.value.reason == "WRITER_REPLACED"


def test_a_part_of_a_blob_can_be_read(write, read):
    data = b"0123456789"
    write(header(data, new_id()), part(data), FINISH)
    assert read(digest(data), offset=3) == b"3456789"
    assert read(digest(data), offset=3, limit_bytes=2) == b"34"
    assert read(digest(data), offset=8, limit_bytes=9) == b"89"
    assert read(digest(data), offset=10) == b""
    for fields in ({"offset": -1}, {"offset": 11}, {"limit_bytes": -1}):
        with pytest.raises(InputError):
            read(digest(data), **fields)
    with pytest.raises(NotFoundError):
        read(digest(b"nothing"))


def test_requests_that_cannot_be_are_refused(write, read):
    data, upload_id = b"some bytes", new_id()
    begun = header(data, upload_id)
    for requests, kind, reason in (
        ([part(data)], InputError, "UPLOAD_ORDER"),
        ([], InputError, "INPUT_INVALID"),
        ([begun, begun], InputError, "UPLOAD_ORDER"),
        ([header(data, "No")], InputError, "ID_INVALID"),
        ([header(data, upload_id, parent="projects/other")], NotFoundError, "NOT_FOUND"),
        ([header(data, upload_id, blob={"sha256": "aa"})], InputError, "ID_INVALID"),
        ([begun, part(data, crc32=1)], InputError, "PART_CRC_MISMATCH"),
        ([begun, part(data, 3)], StateError, "SEQUENCE_GAP"),
        ([begun, part(b"x" * ((1 << 20) + 1))], LimitError, "BLOB_TOO_LARGE"),
        ([begun, FINISH], StateError, "SEQUENCE_GAP"),
    ):
        with pytest.raises(kind) as caught:
            write(*requests)
        assert caught.value.reason == reason
    large = types_pb2.BlobRef(sha256=digest(data), size_bytes=1 << 40)
    with pytest.raises(LimitError) as too_large:
        write(header(data, upload_id, blob=large))
    assert too_large.value.reason == "BLOB_TOO_LARGE"
    with pytest.raises(InputError):
        read("AA")


def test_only_so_many_digests_are_looked_up_at_a_time(connection, stub):
    request = blobs_pb2.FindMissingBlobsRequest(parent=PARENT, sha256=["a" * 64] * 1001)
    with pytest.raises(LimitError):
        connection.call(stub.FindMissingBlobs, request)
