import logging
import struct
import sys

import numpy as np
import pytest
import trimesh

from roel_service.errors import CloudError, InputError, MeshError
from roel_service.io.clouds import read_cloud, read_mesh, read_points, write_npz


@pytest.fixture
def triangles():
    return np.random.default_rng(0).normal(size=(5, 3, 3))


@pytest.fixture
def points():
    return np.random.default_rng(1).normal(size=(7, 3))


def test_mesh_from_npz(tmp_path, triangles):
    write_npz(tmp_path / "m.npz", triangles=triangles, edges=triangles[0])
    mesh = read_mesh(tmp_path / "m.npz")
    np.testing.assert_array_equal(mesh.triangles, triangles.astype(np.float32))


def test_mesh_from_ply_whatever_its_name(tmp_path):
    box = trimesh.creation.box()
    (tmp_path / "m.npz").write_bytes(box.export(file_type="ply"))
    np.testing.assert_array_equal(read_mesh(tmp_path / "m.npz").triangles, box.triangles)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"edges": np.zeros((3, 3))}, "an array triangles"),
        ({"triangles": np.zeros((3, 3))}, "triangles of shape (N, 3, 3)"),
        ({"triangles": np.zeros(())}, "triangles of shape (N, 3, 3)"),
        ({"triangles": np.zeros((0, 3, 3))}, "at least one triangle"),
        ({"triangles": np.full((1, 3, 3), np.nan)}, "finite corners"),
        ({"triangles": np.full((1, 3, 3), 1e300)}, "finite corners"),
    ],
)
def test_what_is_no_mesh_is_refused(tmp_path, arrays, message):
    write_npz(tmp_path / "m.npz", **arrays)
    with pytest.raises(MeshError) as caught:
        read_mesh(tmp_path / "m.npz")
    assert message in str(caught.value)


def test_ply_without_faces_is_no_mesh(tmp_path, points):
    (tmp_path / "m.ply").write_bytes(trimesh.PointCloud(points).export(file_type="ply"))
    with pytest.raises(MeshError, match="expected faces, found none"):
        read_mesh(tmp_path / "m.ply")


def test_points_of_either_key_and_format(tmp_path, points):
    write_npz(tmp_path / "p.npz", edges=points, points=points[:3])
    (tmp_path / "p.ply").write_bytes(trimesh.PointCloud(points).export(file_type="ply"))
    expected = points.astype(np.float32)
    np.testing.assert_array_equal(read_points(tmp_path / "p.npz", "edges").points, expected)
    np.testing.assert_array_equal(read_points(tmp_path / "p.npz", "points").points, expected[:3])
    np.testing.assert_array_equal(read_points(tmp_path / "p.ply", "edges").points, expected)


def test_points_that_are_not_finite_are_left_out_with_one_warning(tmp_path, points, caplog):
    normals = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    points[1, 2] = np.nan
    points[4, 0] = 1e300  # beyond float32
    normals[5, 0] = np.inf
    write_npz(tmp_path / "p.npz", points=points, normals=normals)
    with caplog.at_level(logging.WARNING):
        cloud = read_points(tmp_path / "p.npz", "points")
    np.testing.assert_array_equal(cloud.points, points[[0, 2, 3, 6]].astype(np.float32))
    assert cloud.normals.tolist() == [[0, 0, 1]] * 4
    assert [record.message for record in caplog.records] == [
        f"{tmp_path / 'p.npz'}: left out 3 points that are not finite"
    ]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"edges": np.zeros((3, 3))}, "an array points"),
        ({"points": np.zeros((3, 2))}, "points of shape (N, 3)"),
        ({"points": np.zeros((3, 3), bool)}, "points of shape (N, 3)"),
        ({"points": np.full((3, 3), np.inf)}, "at least 1 finite points"),
        ({"points": np.zeros((3, 3)), "normals": np.zeros((2, 3))}, "normals of shape (3, 3)"),
    ],
)
def test_what_are_no_points_is_refused(tmp_path, arrays, message):
    write_npz(tmp_path / "p.npz", **arrays)
    with pytest.raises(CloudError) as caught:
        read_points(tmp_path / "p.npz", "points")
    assert message in str(caught.value)
    assert caught.value.reason == "CLOUD_INVALID"


def test_too_few_points_are_refused(tmp_path, points):
    write_npz(tmp_path / "p.npz", points=points)
    with pytest.raises(CloudError, match="at least 8 finite points, found 7"):
        read_points(tmp_path / "p.npz", "points", min_count=8)


@pytest.mark.parametrize("content", [b"", b"ply", b"plywood", b"solid x", b"PK\3\4"])
def test_other_files_are_refused(tmp_path, content):
    (tmp_path / "a").write_bytes(content)
    with pytest.raises(InputError):
        read_mesh(tmp_path / "a")
    with pytest.raises(InputError):
        read_points(tmp_path / "a", "points")


SCATTER = np.random.default_rng(2).normal(size=(150, 3)).astype(np.float32)


def test_clouds_as_text_with_or_without_names_and_commas(tmp_path):
    np.savetxt(tmp_path / "a.xyz", SCATTER)
    np.savetxt(
        tmp_path / "b.csv",
        np.c_[SCATTER, SCATTER],
        delimiter=",",
        header="x,y,z,a,b,c",
        comments="",
    )
    for name in ("a.xyz", "b.csv"):
        np.testing.assert_array_equal(read_cloud(tmp_path / name).points, SCATTER)


def test_clouds_as_pcd_ply_and_npz_whatever_their_names(tmp_path):
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 150\nHEIGHT 1\nDATA binary\n"
    (tmp_path / "a").write_bytes(head.encode() + SCATTER.tobytes())
    (tmp_path / "b").write_bytes(trimesh.PointCloud(SCATTER).export(file_type="ply"))
    write_npz(tmp_path / "c", points=SCATTER)
    for name in "abc":
        np.testing.assert_array_equal(read_cloud(tmp_path / name).points, SCATTER)


def las_file(points, *, scale=0.001, format_=0):
    header = bytearray(227)
    header[:4] = b"LASF"
    struct.pack_into("<I", header, 96, 227)
    struct.pack_into("<BHI", header, 104, format_, 20, len(points))
    struct.pack_into("<6d", header, 131, scale, scale, scale, 1.0, 2.0, 3.0)
    rows = np.zeros((len(points), 5), "<i4")
    rows[:, :3] = np.rint((points - [1, 2, 3]) / scale)
    return bytes(header) + rows.tobytes()


def test_clouds_as_las(tmp_path):
    (tmp_path / "a.las").write_bytes(las_file(SCATTER))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.las").points, SCATTER, atol=0.0006)


def test_compressed_points_ask_for_their_extra(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "laspy", None)
    (tmp_path / "a.laz").write_bytes(las_file(SCATTER, format_=0x83))
    with pytest.raises(CloudError, match=r"roel-service\[laz\] installed"):
        read_cloud(tmp_path / "a.laz")


def test_clouds_as_laz(tmp_path):
    laspy = pytest.importorskip("laspy")
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-3)
    cloud = laspy.LasData(header)
    cloud.xyz = SCATTER.astype(np.float64)
    cloud.write(str(tmp_path / "a.laz"))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.laz").points, SCATTER, atol=0.0006)
    (tmp_path / "a.laz").write_bytes((tmp_path / "a.laz").read_bytes()[:-40])
    with pytest.raises(CloudError, match="a LAZ file"):
        read_cloud(tmp_path / "a.laz")


def vtk_file(points, encoding):
    head = f"# vtk DataFile Version 3.0\ndata\n{encoding}\nDATASET POLYDATA\nPOINTS {len(points)} float\n"
    tail = b"\nVERTICES 1 2\n1 0\n"
    if encoding == "BINARY":
        return head.encode() + points.astype(">f4").tobytes()
    return head.encode() + b"\n".join(b"%r %r %r" % tuple(map(float, p)) for p in points) + tail


@pytest.mark.parametrize("encoding", ["ASCII", "BINARY"])
def test_clouds_as_vtk(tmp_path, encoding):
    (tmp_path / "a.vtk").write_bytes(vtk_file(SCATTER, encoding))
    np.testing.assert_allclose(read_cloud(tmp_path / "a.vtk").points, SCATTER, rtol=1e-6)


@pytest.mark.parametrize(
    ("data", "found"),
    [
        (las_file(SCATTER)[:-1], "150 points in 3226 bytes"),
        (las_file(SCATTER)[:100], "100 bytes"),
        (las_file(SCATTER + np.array([5e5, 0, 0])), "500 m if these are millimetres"),
        (b"no cloud at all\n", "PLY, PCD, LAS, LAZ, VTK, NPZ, mesh or text"),
        (b"1 2\n3 4\n", "at least the columns x y z"),
        (b"", "no numbers"),
        (vtk_file(SCATTER, "BINARY")[:-1], "150 points in 1799 bytes"),
        (
            vtk_file(SCATTER, "ASCII").replace(b"POINTS 150", b"POINTS 170"),
            "450 coordinates, not 510",
        ),
        (vtk_file(SCATTER, "ASCII").replace(b"POINTS", b"CELLS"), "no POINTS of float or double"),
        (vtk_file(SCATTER, "ASCII").replace(b"ASCII", b"BASE64"), "the encoding 'BASE64'"),
        (vtk_file(SCATTER, "ASCII").replace(b"POINTS 150", b"POINTS 9" + 15 * b"0"), "points in"),
        (b"1 2 3\n4 5 6\n7 8 9\n", "at least 100 finite points, found 3"),
        (b"OFF\n1 0 0\n0 0 0\n", "a mesh"),
    ],
)
def test_what_is_no_cloud_is_refused(tmp_path, data, found):
    (tmp_path / "c").write_bytes(data)
    with pytest.raises(CloudError) as caught:
        read_cloud(tmp_path / "c")
    assert found in str(caught.value)


@pytest.mark.parametrize("kind", ["ply", "obj", "off", "stl", "stl_ascii", "glb"])
def test_meshes_are_sampled_evenly(tmp_path, kind):
    box = trimesh.creation.box(extents=(1, 1, 3))
    data = box.export(file_type=kind)
    (tmp_path / "mesh").write_bytes(data.encode() if isinstance(data, str) else data)
    cloud = read_cloud(tmp_path / "mesh")
    on_cap = np.abs(cloud.points[:, 2]).round(5) == 1.5
    assert on_cap.mean() == pytest.approx(2 / 14, abs=1e-3)
    np.testing.assert_allclose(np.abs(cloud.points / [0.5, 0.5, 1.5]).max(axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(np.abs(cloud.normals[on_cap, 2]).mean(), 1.0, atol=1e-3)
