import numpy as np
import pytest

from roel_service.config.stages import RegisterConfig
from roel_service.errors import CloudError, NoAnswerError
from roel_service.geometry.se3 import SE3, rotation_angle, rotation_from_vector
from roel_service.register.prepare import prepare_cloud
from roel_service.register.register import register_map
from roel_service.scene.clouds import PointCloud
from roel_service.scene.lines import LineMap
from roel_service.scene.results import Verdict
from tests.register.rooms import room_cloud, room_map

CONFIG = RegisterConfig()
NUDGE = SE3(rotation=rotation_from_vector(np.array([0.02, -0.03, 0.05])), translation=[0.03, 0, 0])


@pytest.fixture(scope="module")
def prepared():
    return prepare_cloud(room_cloud(), CONFIG)


def errors(found, true=None):
    """Rotation in degrees and translation in mm between two transforms."""
    off = found @ (true or SE3.identity()).inverse()
    return np.degrees(rotation_angle(off.rotation)), 1e3 * np.linalg.norm(off.translation)


def test_point_icp_comes_close_from_a_close_start(prepared):
    result = register_map(room_map(), prepared, CONFIG, method="point", T_init=NUDGE)
    degrees, millimetres = errors(result.T_target_source)
    assert degrees < 1.0
    assert millimetres < 30.0
    assert result.converged
    assert result.verdict is Verdict.ACCEPTED


def test_a_map_without_lines_has_no_answer(prepared):
    with pytest.raises(NoAnswerError) as caught:
        register_map(LineMap.from_segments(np.empty((0, 2, 3))), prepared, CONFIG)
    assert caught.value.reason == "TOO_FEW_LINES"


@pytest.mark.parametrize(
    ("factor", "unit"), [(1e3, "millimetres and metres"), (1e-3, "metres and")]
)
def test_a_unit_that_is_off_by_a_thousand_is_named(factor, unit):
    cloud = room_cloud(count=1000)
    scaled = PointCloud(points=cloud.points * np.float32(factor))
    with pytest.raises(CloudError, match=f"factor of about 1000, as between {unit}") as caught:
        register_map(room_map(), scaled, CONFIG)
    assert caught.value.reason == "CLOUD_UNIT"
