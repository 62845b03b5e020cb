import numpy as np
import pytest

from roel_service.geometry.se3 import rotation_from_vector
from roel_service.register.vertical import Vertical

UPS = [np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0]), np.array([0.6, -0.8, 0.0])]


@pytest.mark.parametrize("up_source", UPS)
@pytest.mark.parametrize("up_target", UPS)
def test_headings_lay_up_on_up(up_source, up_target):
    vertical = Vertical(up_source=up_source, up_target=up_target)
    angles = np.array([-2.0, 0.0, 0.7])
    rotations = vertical.turned(angles)
    np.testing.assert_allclose(rotations @ up_source, np.tile(up_target, (3, 1)), atol=1e-12)
    np.testing.assert_allclose(vertical.headings_rad(rotations), angles, atol=1e-12)


def test_rotations_that_tilt_have_no_heading():
    angles = np.radians([[5.0], [12.0]])
    rotations = rotation_from_vector(angles * [1.0, 0.0, 0.0])
    assert len(Vertical().headings_rad(rotations)) == 1
