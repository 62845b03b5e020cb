import contextlib
import io
import zipfile

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roel_service.errors import CloudError, InputError
from roel_service.io.npz import read_npz, write_npz


def read(path, *names):
    return read_npz(path, names, str(path), CloudError)


def refused(path, name="a"):
    with pytest.raises(CloudError, match="expected an undamaged NPZ archive") as caught:
        read(path, name)
    return str(caught.value)


def member(header, data=b"", name="a.npy", version=b"\1\0"):
    """Bytes of an archive whose one member has this header."""
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w") as file:
        length = len(header).to_bytes(2 if version == b"\1\0" else 4, "little")
        file.writestr(name, b"\x93NUMPY" + version + length + header + data)
    return archive.getvalue()


@given(
    hnp.arrays(
        st.sampled_from(["?", "<i2", ">i4", "<u8", "<f4", ">f8"]),
        hnp.array_shapes(min_dims=0, max_dims=3, min_side=0),
    ),
    st.booleans(),
)
@settings(deadline=None)
def test_arrays_of_numpy_are_read(tmp_path_factory, array, compressed):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    save = np.savez_compressed if compressed else np.savez
    save(path, a=array, b=np.asfortranarray(array), other=np.array(["text"]))
    back = read(path, "a", "b", "missing")
    assert back.keys() == {"a", "b"}
    for values in back.values():
        np.testing.assert_array_equal(values, array)
        assert values.dtype.isnative


def test_equal_arrays_give_equal_bytes(tmp_path):
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.array([1, 2], np.int32)}
    write_npz(tmp_path / "1.npz", **arrays)
    write_npz(tmp_path / "2.npz", **arrays)
    assert (tmp_path / "1.npz").read_bytes() == (tmp_path / "2.npz").read_bytes()
    with np.load(tmp_path / "1.npz", allow_pickle=False) as loaded:
        assert list(loaded) == ["b", "a"]
        for name, values in arrays.items():
            np.testing.assert_array_equal(loaded[name], values)
            assert loaded[name].dtype == values.dtype


def test_pickled_objects_are_refused(tmp_path):
    np.savez(tmp_path / "a.npz", a=np.array([{"any": "object"}], dtype=object))
    assert "no array of plain numbers" in refused(tmp_path / "a.npz")


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (1000000000000,), }\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (999999999999999999, 9), }\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }\n",
        b"{'descr': '<f3', 'fortran_order': False, 'shape': (1,), }\n",
        b"{'descr': '<b8', 'fortran_order': False, 'shape': (1,), }\n",
        b"{'descr': '<U2', 'fortran_order': False, 'shape': (1,), }\n",
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }\n",
        b"(" * 9000,
        b"",
    ],
)
def test_header_that_does_not_fit_its_data_is_refused(tmp_path, header):
    (tmp_path / "a.npz").write_bytes(member(header, bytes(8)))
    refused(tmp_path / "a.npz")


def test_member_beyond_any_compression_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=np.zeros(10))
    content = bytearray(path.read_bytes())
    # The size in the central directory, which is what zipfile believes.
    position = content.rindex(b"PK\1\2") + 24
    content[position : position + 4] = (2**31).to_bytes(4, "little")
    path.write_bytes(content)
    assert "claims 2147483648 bytes" in refused(path)


@pytest.mark.parametrize("content", [b"", b"PK\3\4", b"no archive at all"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a.npz").write_bytes(content)
    refused(tmp_path / "a.npz")


@given(st.data())
@settings(max_examples=150, deadline=None)
def test_damaged_bytes_are_refused_or_harmless(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("npz") / "a.npz"
    write_npz(path, a=np.arange(12.0).reshape(4, 3))
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    for _ in range(data.draw(st.integers(0, 3))):
        if content:
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        assert sum(values.size for values in read(path, "a").values()) in (0, 12)
