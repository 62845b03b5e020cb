import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import CorruptionError
from roel_service.store.blobs import BlobStore


@pytest.fixture(scope="module")
def blobs(tmp_path_factory):
    return BlobStore(tmp_path_factory.mktemp("blobs") / "sha256")


@given(st.binary(max_size=300))
def test_bytes_come_back_under_their_digest(blobs, data):
    sha256 = blobs.put(data)
    assert sha256 == hashlib.sha256(data).hexdigest()
    assert blobs.read(sha256) == data


def test_equal_bytes_are_one_blob_and_leave_no_temporary_file(tmp_path):
    blobs = BlobStore(tmp_path)
    assert blobs.put(b"same") == blobs.put(b"same")
    assert len([path for path in tmp_path.rglob("*") if path.is_file()]) == 1


def test_an_adopted_file_keeps_its_name(tmp_path):
    blobs = BlobStore(tmp_path / "blobs")
    source = tmp_path / "source"
    source.write_bytes(b"bytes")
    assert blobs.read(blobs.adopt(source)) == b"bytes"
    assert source.exists()


@pytest.mark.parametrize("damage", [b"other", b""])
def test_changed_bytes_are_never_returned(tmp_path, damage):
    blobs = BlobStore(tmp_path)
    sha256 = blobs.put(b"right")
    blobs.path(sha256).write_bytes(damage)
    with pytest.raises(CorruptionError, match=sha256):
        blobs.read(sha256)


def test_a_lost_blob_is_corruption(tmp_path):
    blobs = BlobStore(tmp_path)
    sha256 = blobs.put(b"right")
    blobs.path(sha256).unlink()
    with pytest.raises(CorruptionError, match=sha256):
        blobs.read(sha256)
