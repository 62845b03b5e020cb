import numpy as np
import pytest

from roel_bench.creases import crease_segments, offsets_px
from roel_bench.visible_edges import VisibleEdges
from roel_service.geometry.projection import project
from roel_service.scene.clouds import TriangleMesh
from tests.bench.samples import AT_ORIGIN, CAMERA, quad, square, truth

K = CAMERA.matrix
# Projection of float32 corners: micrometres at 2 m are 1e-4 px.
TOLERANCE_PX = 1e-3


def offsets(lines, triangles):
    visible = VisibleEdges(truth(triangles, [[0, 0, 1]]), CAMERA)
    creases = crease_segments(TriangleMesh(triangles=triangles))
    return offsets_px(np.array(lines, dtype=float), creases, visible, AT_ORIGIN, K)


def side_of(square_m, z_m):
    """(2, 2) px: most of the right side of a square before the camera."""
    h = square_m / 2
    return project(np.array([[h, -0.9 * h, z_m], [h, 0.9 * h, z_m]]), K)


def test_flat_surface_has_its_border_alone():
    creases = crease_segments(TriangleMesh(triangles=square(2.0, 2.0)))
    assert len(creases) == 4
    assert np.linalg.norm(creases[:, 1] - creases[:, 0], axis=1) == pytest.approx([2, 2, 2, 2])


def test_surfaces_that_meet_at_an_angle_have_a_crease():
    floor = quad([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    wall = quad([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    creases = crease_segments(TriangleMesh(triangles=np.concatenate([floor, wall])))
    # Four sides each, one of them common.
    assert len(creases) == 7


@pytest.mark.parametrize("shift_px", [-1.2, 0.0, 0.7])
def test_offset_has_the_sign_of_the_lines_left_normal(shift_px):
    line = np.add(side_of(1.0, 2.0), [shift_px, 0.0])
    # Downwards, so that the left normal (-dy, dx) points to -x; the crease lies at -shift.
    assert offsets([line], square(1.0, 2.0)) == pytest.approx([shift_px], abs=TOLERANCE_PX)
    assert offsets([line[::-1]], square(1.0, 2.0)) == pytest.approx([-shift_px], abs=TOLERANCE_PX)


def test_lines_of_no_crease_and_hidden_creases_have_no_offset():
    far = np.add(side_of(1.0, 2.0), [3.0, 0.0])
    turned = np.add(side_of(1.0, 2.0), [[-1.0, 0.0], [1.0, 0.0]])
    assert np.isnan(offsets([far, turned], square(1.0, 2.0))).all()
    behind_a_wall = np.concatenate([square(1.0, 2.0), square(6.0, 1.0)])
    assert np.isnan(offsets([side_of(1.0, 2.0)], behind_a_wall)).all()


def test_two_creases_side_by_side_leave_it_open():
    # The right sides of the two squares project 2.5 px apart.
    both = np.concatenate([square(1.0, 2.0), square(1.0 + 2 * 2.5 / 30.0, 2.0)])
    assert np.isnan(offsets([side_of(1.0, 2.0)], both)).all()


def test_scanned_surfaces_and_empty_pictures():
    scanned = np.repeat(square(1.0, 2.0), 10_001, axis=0)
    assert len(crease_segments(TriangleMesh(triangles=scanned))) == 0
    assert len(offsets(np.empty((0, 2, 2)), square(1.0, 2.0))) == 0
