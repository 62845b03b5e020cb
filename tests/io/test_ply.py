import contextlib

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import InputError, MeshError
from roel_service.io.ply import read_ply

SQUARE = """ply
format ascii 1.0
comment made by hand
element vertex 4
property double x
property float32 y
property float z
property uchar red
element face 1
property list uchar int vertex_index
end_header
0 0 0 9
1 0 0 9
1 1 0 9
0 1 0.5 9
4 0 1 2 3
"""

BIG_ENDIAN_HEADER = b"""ply
format binary_big_endian 1.0
element material 2
property uchar gloss
element vertex 3
property float nx
property float ny
property float nz
property double x
property double y
property double z
element face 2
property uchar flag
property list ushort uint vertex_indices
end_header
"""


def write(tmp_path, content):
    path = tmp_path / "a.ply"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path


def refused(tmp_path, content):
    with pytest.raises(MeshError) as caught:
        read_ply(write(tmp_path, content), MeshError)
    assert caught.value.subject == str(tmp_path / "a.ply")
    return str(caught.value)


def big_endian():
    vertices = np.zeros(3, [("normal", ">f4", 3), ("point", ">f8", 3)])
    vertices["normal"] = [0, 0, 1]
    vertices["point"] = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    faces = np.zeros(2, [("flag", "u1"), ("count", ">u2"), ("corners", ">u4", 3)])
    faces["count"] = 3
    faces["corners"] = [[0, 1, 2], [2, 1, 0]]
    return BIG_ENDIAN_HEADER + b"\7\7" + vertices.tobytes() + faces.tobytes()


@pytest.mark.parametrize("encoding", ["ascii", "binary"])
def test_meshes_of_another_program_are_read(tmp_path, encoding):
    sphere = trimesh.creation.icosphere(subdivisions=2)
    ply = read_ply(write(tmp_path, sphere.export(file_type="ply", encoding=encoding)), MeshError)
    np.testing.assert_array_equal(ply.faces, sphere.faces)
    # That program writes float32 or 8 digits of a unit sphere.
    np.testing.assert_allclose(ply.vertices, sphere.vertices, rtol=0, atol=1e-7)


def test_polygons_become_fans(tmp_path):
    ply = read_ply(write(tmp_path, SQUARE), MeshError)
    assert ply.vertices[3].tolist() == [0, 1, 0.5]
    assert ply.normals is None
    assert ply.faces.tolist() == [[0, 1, 2], [0, 2, 3]]


def test_normals_lists_and_unknown_elements_of_either_byte_order(tmp_path):
    ply = read_ply(write(tmp_path, big_endian()), MeshError)
    assert ply.normals.tolist() == [[0, 0, 1]] * 3
    assert ply.vertices.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    assert ply.faces.tolist() == [[0, 1, 2], [2, 1, 0]]


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("element vertex 4", "element vertex 5"),
        ("element vertex 4", "element vertex 900000000000000000"),
        ("element vertex 4", "element vertex -4"),
        ("element face 1", "element face 2"),
        ("4 0 1 2 3", "4 0 1 2"),
        ("4 0 1 2 3", "4 0 1 2 4"),
        ("4 0 1 2 3", "4 0 1 2 -1"),
        ("4 0 1 2 3", "4 0 1 2 x"),
        ("property double x", "property quad x"),
        ("property double x", "property double w"),
        ("property double x", "property list uchar int x"),
        ("format ascii 1.0\n", ""),
        ("format ascii", "format utf8"),
        ("end_header", "end"),
        ("ply\n", "obj\n"),
        ("comment", "remark"),
    ],
)
def test_damaged_text_is_refused(tmp_path, old, new):
    assert old in SQUARE
    refused(tmp_path, SQUARE.replace(old, new, 1))


def test_binary_shorter_than_its_claim_is_refused(tmp_path):
    content = big_endian()
    assert "2 x face" in refused(tmp_path, content[:-1])
    huge = content.replace(b"vertex 3", b"vertex 300000000000")
    assert "300000000000 x vertex" in refused(tmp_path, huge)


def test_faces_of_different_sizes_are_refused(tmp_path):
    text = SQUARE.replace("face 1", "face 2") + "3 0 1 2\n"
    refused(tmp_path, text)


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_damaged_bytes_are_refused_or_a_mesh(tmp_path_factory, data):
    content = bytearray(data.draw(st.sampled_from([SQUARE.encode(), big_endian()])))
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    for _ in range(data.draw(st.integers(0, 3)) if content else 0):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    path = write(tmp_path_factory.mktemp("ply"), bytes(content))
    with contextlib.suppress(InputError):
        assert read_ply(path, MeshError).vertices.shape[1] == 3
