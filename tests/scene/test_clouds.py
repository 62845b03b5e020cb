import numpy as np
import pytest

from roel_service.scene.clouds import PointCloud, TriangleMesh


def test_points_are_stored_as_float32_with_normals_of_the_same_count():
    cloud = PointCloud(points=np.eye(3), normals=np.eye(3))
    assert len(cloud) == 3
    assert cloud.points.dtype == cloud.normals.dtype == np.float32
    assert PointCloud(points=np.eye(3)).normals is None


def test_cloud_may_be_empty():
    assert len(PointCloud(points=np.empty((0, 3)))) == 0


@pytest.mark.parametrize(
    ("points", "normals", "named"),
    [
        (np.zeros((4, 2)), None, "points"),
        (np.full((4, 3), np.nan), None, "points"),
        (np.zeros((4, 3)), np.zeros((3, 3)), "normals"),
    ],
)
def test_wrong_clouds_are_refused_by_name(points, normals, named):
    with pytest.raises(ValueError, match=named):
        PointCloud(points=points, normals=normals)


def test_mesh_is_a_list_of_finite_triangles():
    assert len(TriangleMesh(triangles=np.zeros((5, 3, 3)))) == 5
    for wrong in (np.zeros((5, 3)), np.full((1, 3, 3), np.inf)):
        with pytest.raises(ValueError, match="triangles"):
            TriangleMesh(triangles=wrong)
