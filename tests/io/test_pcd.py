import contextlib
import struct

import numpy as np
import open3d
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import CloudError
from roel_service.io.pcd import read_pcd, unpack_lzf

HEADER = """# .PCD v0.7
VERSION 0.7
FIELDS x y z rgb
SIZE 4 4 4 4
TYPE F F F U
COUNT 1 1 1 1
WIDTH 2
HEIGHT 1
VIEWPOINT 0 0 0 1 0 0 0
POINTS 2
DATA ascii
"""


@pytest.mark.parametrize(("ascii_", "compressed"), [(True, False), (False, False), (False, True)])
@pytest.mark.parametrize("with_normals", [False, True])
def test_every_encoding_reads_as_open3d_wrote_it(tmp_path, ascii_, compressed, with_normals):
    rng = np.random.default_rng(0)
    points = np.round(rng.normal(size=(300, 3)), 2).astype(np.float32)
    normals = np.repeat(np.eye(3), 100, axis=0)
    cloud = open3d.geometry.PointCloud(open3d.utility.Vector3dVector(points.astype(np.float64)))
    if with_normals:
        cloud.normals = open3d.utility.Vector3dVector(normals)
    path = str(tmp_path / "p.pcd")
    assert open3d.io.write_point_cloud(path, cloud, write_ascii=ascii_, compressed=compressed)
    found, found_normals = read_pcd(tmp_path / "p.pcd")
    np.testing.assert_allclose(found, points, atol=1e-6)
    if with_normals:
        np.testing.assert_array_equal(found_normals, normals)
    else:
        assert found_normals is None


def test_other_fields_are_passed_over(tmp_path):
    (tmp_path / "p.pcd").write_text(HEADER + "1 2 3 99\n4 5 nan 98\n")
    points, normals = read_pcd(tmp_path / "p.pcd")
    np.testing.assert_array_equal(points, [[1, 2, 3], [4, 5, np.nan]])
    assert normals is None


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ("x y z rgb", "x y w rgb", "no fields x y z"),
        ("SIZE 4", "SIZE 3", "fields without a type"),
        ("POINTS 2", "POINTS 99999999", "8 values for 99999999 points"),
        ("POINTS 2", "POINTS -2", "numbers '-2'"),
        ("DATA ascii", "DATA binary", "2 points in 16 bytes"),
        ("DATA ascii", "DATA binary_compressed", "packed in"),
        ("DATA ascii", "DATA zip", "DATA zip"),
        ("VIEWPOINT", "OPINION", "the header line 'OPINION"),
        ("COUNT 1", "COUNT 99999", "a field of 99999 values"),
        ("DATA ascii\n", "", "the header line '1 2 3 4'"),
    ],
)
def test_damage_is_told_in_one_line(tmp_path, old, new, found):
    (tmp_path / "p.pcd").write_text(HEADER.replace(old, new) + "1 2 3 4\n5 6 7 8\n")
    with pytest.raises(CloudError) as caught:
        read_pcd(tmp_path / "p.pcd")
    assert found in str(caught.value)


def test_a_claimed_size_is_not_allocated(tmp_path):
    header = HEADER.replace("POINTS 2", "POINTS 400000000").replace("ascii", "binary_compressed")
    body = struct.pack("<II", 4, 1 << 32 - 1) + b"\0\0\0\0"
    (tmp_path / "p.pcd").write_bytes(header.encode() + body)
    with pytest.raises(CloudError, match="bytes packed in 4"):
        read_pcd(tmp_path / "p.pcd")


def test_a_copy_may_reach_its_own_end():
    # The literal "ab", then 7 bytes from 2 back.
    assert unpack_lzf(bytes([1, *b"ab", 5 << 5, 1]), 9) == b"ababababa"


@given(st.binary(max_size=64), st.integers(0, 300))
def test_random_bytes_unpack_to_the_size_or_raise(packed, size):
    with contextlib.suppress(ValueError):
        assert len(unpack_lzf(packed, size)) == size
