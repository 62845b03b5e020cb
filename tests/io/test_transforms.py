import numpy as np
import pytest

from roel_service.errors import InputError
from roel_service.geometry.se3 import rotation_from_vector
from roel_service.io.transforms import read_transform


def matrix(rotation=None, translation=(1, 2, 3)):
    T = np.eye(4)
    T[:3, :3] = np.eye(3) if rotation is None else rotation
    T[:3, 3] = translation
    return T


def test_rounded_rotations_are_made_exact(tmp_path):
    rotation = rotation_from_vector(np.array([0.1, -0.4, 0.9]))
    np.savetxt(tmp_path / "T.txt", matrix(rotation), fmt="%.4f", header="a guess")
    T = read_transform(tmp_path / "T.txt")
    np.testing.assert_allclose(T.rotation, rotation, atol=1e-4)
    np.testing.assert_allclose(T.rotation.T @ T.rotation, np.eye(3), atol=1e-12)
    np.testing.assert_array_equal(T.translation, [1, 2, 3])


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (matrix()[:3], "four lines of four numbers"),
        (matrix() + np.eye(4), "a last row of 0 0 0 1"),
        (matrix(1.01 * np.eye(3)), "a rotation within 0.001"),
        (matrix(np.diag([1.0, 1.0, -1.0])), "a rotation within 0.001"),
        (matrix(translation=(np.nan, 0, 0)), "finite numbers"),
        (np.eye(3), "finite numbers"),
    ],
)
def test_what_is_no_transform_is_refused(tmp_path, rows, expected):
    np.savetxt(tmp_path / "T.txt", rows)
    with pytest.raises(InputError, match=expected):
        read_transform(tmp_path / "T.txt")
