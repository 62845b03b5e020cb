"""Random geometry for property tests, and the one way in which lines and segments are compared."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from roel_service.geometry.se3 import SE3, rotation_from_vector
from roel_service.geometry.vectors import norm, unit

BATCH_SHAPES = [(), (3,), (2, 3)]


def arrays(shape, low=-1.0, high=1.0):
    elements = st.floats(low, high, allow_subnormal=False)
    return hnp.arrays(np.float64, shape, elements=elements)


def points(shape=(), size_m=10.0):
    return arrays((*shape, 3), -size_m, size_m)


def unit_vectors(shape=()):
    """Directions away from the zero vector, so that the normalisation is harmless."""
    return arrays((*shape, 3)).filter(lambda v: (norm(v) > 0.1).all()).map(unit)


def rotations(shape=(), max_angle_rad=np.pi):
    vectors = arrays((*shape, 3), -max_angle_rad / np.sqrt(3), max_angle_rad / np.sqrt(3))
    return vectors.map(rotation_from_vector)


def poses(shape=(), size_m=10.0, max_angle_rad=np.pi):
    return st.builds(
        lambda rotation, translation: SE3(rotation=rotation, translation=translation),
        rotations(shape, max_angle_rad),
        points(shape, size_m),
    )


def segments(shape=(), size=10.0, dimensions=3, min_length=0.1):
    return arrays((*shape, 2, dimensions), -size, size).filter(
        lambda s: (norm(s[..., 1, :] - s[..., 0, :]) > min_length).all()
    )


def assert_same_lines(direction_1, moment_1, direction_2, moment_2, atol):
    """Equal up to the sign of the line."""
    sign = np.sign(np.vecdot(direction_1, direction_2))[..., None]
    np.testing.assert_allclose(sign * direction_1, direction_2, rtol=0, atol=atol)
    np.testing.assert_allclose(sign * moment_1, moment_2, rtol=0, atol=atol)


def central_difference(function, size, step):
    """(..., size) derivative of a function of `size` numbers at zero."""
    columns = []
    for index in range(size):
        delta = np.zeros(size)
        delta[index] = step
        columns.append((function(delta) - function(-delta)) / (2 * step))
    return np.stack(columns, axis=-1)
