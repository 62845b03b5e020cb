import numpy as np
import pytest
from hypothesis import given

from roel_service.geometry.vectors import MIN_LENGTH, angle_between, any_normal, unit

from .strategies import points, unit_vectors


def test_zero_vector_has_no_direction():
    directions = unit(np.array([[0.0, 0.0, 0.0], [0.0, 3.0, 4.0]]))
    assert np.isnan(directions[0]).all()
    np.testing.assert_allclose(directions[1], [0, 0.6, 0.8], rtol=1e-15)


@pytest.mark.parametrize("length", [1e-200, 1e-160, 1e-149, 1e-8, 1e150])
def test_direction_has_length_one_or_is_refused(length):
    direction = unit(length * np.array([0.0, 1.0, -1.0]))
    if length < MIN_LENGTH:
        assert np.isnan(direction).all()
    else:
        np.testing.assert_allclose(direction, np.sqrt(0.5) * np.array([0, 1, -1]), rtol=1e-15)


@given(unit_vectors((4,)))
def test_any_normal_is_a_unit_vector_at_right_angles(directions):
    normals = any_normal(directions)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, rtol=1e-15)
    np.testing.assert_allclose(np.vecdot(normals, directions), 0.0, atol=1e-15)


@pytest.mark.parametrize("angle_rad", [0.0, 1e-12, 1e-8, 0.3, np.pi / 2, np.pi - 1e-8, np.pi])
def test_angle_keeps_its_digits_near_zero_and_pi(angle_rad):
    a = np.array([2.0, 0.0, 0.0])
    b = 5.0 * np.array([np.cos(angle_rad), np.sin(angle_rad), 0.0])
    assert angle_between(a, b) == pytest.approx(angle_rad, rel=1e-15, abs=1e-24)


@given(points(), points())
def test_angle_is_symmetric_and_at_most_pi(a, b):
    assert angle_between(a, b) == angle_between(b, a)
    assert 0.0 <= angle_between(a, b) <= np.pi
