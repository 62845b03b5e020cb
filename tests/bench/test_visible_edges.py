import numpy as np
import pytest

from roel_bench.scenes import MapTruth
from roel_bench.visible_edges import VisibleEdges
from roel_service.errors import CloudError
from roel_service.geometry.se3 import SE3
from roel_service.scene.clouds import TriangleMesh
from tests.bench.samples import AT_ORIGIN, CAMERA, HEIGHT, WIDTH, square, truth


def points_on(*rows):
    return VisibleEdges(truth(square(4.0, 2.0), rows), CAMERA)


def test_points_behind_a_surface_are_not_seen():
    visible = points_on([0, 0, 1.0], [0.1, 0, 2.0], [0.2, 0, 2.5])
    points, pixels = visible.points_in_view(AT_ORIGIN)
    assert points[:, 2].tolist() == [1.0, 2.0]
    # x / z times 60 px, from the middle of the picture.
    assert pixels[1] == pytest.approx([31.5 + 3.0, 23.5])


def test_a_point_a_little_inside_its_surface_is_seen():
    points, _ = points_on([0, 0, 2.004]).points_in_view(AT_ORIGIN)
    assert len(points) == 1


def test_points_outside_the_picture_or_behind_the_camera_are_not_seen():
    points, _ = points_on([2.0, 0, 2.0], [0, 0, -1.0]).points_in_view(AT_ORIGIN)
    assert len(points) == 0


def test_edge_map_joins_points_to_one_thin_line():
    # Along x at 2 m, 30 px a metre; points 0.7 px apart in two rows 0.15 px apart.
    x = np.arange(-0.8, 0.8, 0.0233)
    rows = [[value, y, 2.0] for value in x for y in (0.0, 0.005)]
    edge_map = points_on(*rows).edge_map(AT_ORIGIN)
    assert edge_map.shape == (HEIGHT, WIDTH)
    columns = edge_map.any(axis=0)
    assert columns[9:55].all()
    assert edge_map[:, 9:55].sum(axis=0).max() == 1


def test_speed_of_the_picture():
    moved = SE3(rotation=np.eye(3), translation=np.array([0.01, 0.0, 0.0]))
    # 0.01 m at 2 m is 0.3 px, in 5 ms.
    speed = points_on([0, 0, 2.0], [0.1, 0, 2.0]).speed_px_per_ms(AT_ORIGIN, moved, 5.0)
    assert speed == pytest.approx(0.06)
    assert np.isnan(points_on([0, 0, -1.0]).speed_px_per_ms(AT_ORIGIN, moved, 5.0))


def test_truth_without_edges_is_refused():
    mesh = TriangleMesh(triangles=square(4.0, 2.0))
    with pytest.raises(CloudError, match="edge points"):
        VisibleEdges(MapTruth(mesh=mesh, edges=None), CAMERA)
