import numpy as np
import pytest
import trimesh
from PIL import Image

from roel_service.errors import MeshError
from roel_service.simulate.meshes import scene_from_mesh

SUFFIXES = ("glb", "obj", "ply")


def painted_box() -> trimesh.Trimesh:
    """A box of 1 x 2 x 3 with one colour for each of its twelve triangles."""
    box = trimesh.creation.box((1.0, 2.0, 3.0))
    # Each triangle gets its own corners, so that formats which keep the colours of corners do too.
    box = trimesh.Trimesh(box.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3), process=False)
    colours = np.repeat(np.arange(20, 260, 20)[:, None], 3, axis=1).astype(np.uint8)
    box.visual = trimesh.visual.ColorVisuals(box, vertex_colors=np.repeat(colours, 3, axis=0))
    return box


def textured_square() -> trimesh.Trimesh:
    """A square whose upper left quarter is white; v counts upwards."""
    image = np.zeros((32, 32, 3), np.uint8)
    image[:16, :16] = 255
    return trimesh.Trimesh(
        vertices=[[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
        faces=[[0, 1, 2], [0, 2, 3]],
        visual=trimesh.visual.TextureVisuals(
            uv=[[0, 0], [1, 0], [1, 1], [0, 1]],
            material=trimesh.visual.material.SimpleMaterial(image=Image.fromarray(image)),
        ),
        process=False,
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_mesh_keeps_its_triangles_and_colours(tmp_path, suffix):
    path = tmp_path / f"box.{suffix}"
    painted_box().export(path)
    scene = scene_from_mesh(path)
    assert scene.triangles.shape == (12, 3, 3)
    # glTF is y up: what was y there is z here.
    size = [1.0, 3.0, 2.0] if suffix == "glb" else [1.0, 2.0, 3.0]
    np.testing.assert_allclose(np.ptp(scene.bounds_m, axis=0), size, atol=1e-6)
    assert len(np.unique(scene.textures[0].reshape(-1, 3), axis=0)) >= 12


@pytest.mark.parametrize("suffix", ["glb", "obj"])
def test_a_picture_is_mapped_the_right_way_up(tmp_path, suffix):
    path = tmp_path / f"square.{suffix}"
    textured_square().export(path)
    scene = scene_from_mesh(path)
    assert scene.textures[0].shape == (32, 32, 3)
    corner = scene.triangles.reshape(-1, 3)
    # The corner at x = 0 and the upper end belongs to the first row and column of the picture.
    upward = corner[:, 2] if suffix == "glb" else corner[:, 1]
    upper_left = (corner[:, 0] == 0) & (upward == 1)
    assert upper_left.any()
    np.testing.assert_allclose(scene.uv.reshape(-1, 2)[upper_left] % 1.0, 0.0, atol=1e-6)
    assert scene.textures[0][2, 2].min() == 1.0
    assert scene.textures[0][-2, 2].max() < 0.1


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_what_is_no_mesh_is_refused_by_name(tmp_path, suffix):
    path = tmp_path / f"noise.{suffix}"
    path.write_bytes(bytes(range(256)) * 4)
    with pytest.raises(MeshError) as caught:
        scene_from_mesh(path)
    assert (caught.value.subject, caught.value.reason) == (str(path), "MESH_INVALID")


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_a_truncated_mesh_is_refused(tmp_path, suffix):
    whole = tmp_path / f"whole.{suffix}"
    painted_box().export(whole)
    data = whole.read_bytes()
    path = tmp_path / f"cut.{suffix}"
    path.write_bytes(data[: 20 if suffix == "obj" else len(data) // 2])
    with pytest.raises(MeshError):
        scene_from_mesh(path)


def test_a_missing_file_is_refused(tmp_path):
    with pytest.raises(MeshError, match="no such file"):
        scene_from_mesh(tmp_path / "none.glb")


def test_points_without_triangles_are_refused(tmp_path):
    path = tmp_path / "points.ply"
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(9, 3))).export(path)
    with pytest.raises(MeshError, match="triangles"):
        scene_from_mesh(path)


def test_a_corner_that_is_not_finite_is_refused(tmp_path):
    path = tmp_path / "nan.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", encoding="utf-8")
    with pytest.raises(MeshError):
        scene_from_mesh(path)
