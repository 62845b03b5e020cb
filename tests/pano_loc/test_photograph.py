import numpy as np
import pytest

from roel_service.config.stages import LocalizeConfig
from roel_service.errors import InputError
from roel_service.evaluation.poses import rotation_errors_rad, translation_errors_m
from roel_service.geometry.se3 import SE3
from roel_service.pano_loc.hints import PosePrior
from roel_service.pano_loc.localize import localize_photograph
from roel_service.pano_loc.photograph import arcs_of_photograph
from roel_service.pano_loc.prepare import prepare_map
from roel_service.scene.camera import Camera
from roel_service.scene.results import LocalizationStatus, NoPoseReason
from tests.pano_loc.rooms import map_of, pose, segments_of
from tests.pano_loc.wireframe import wireframe_photograph

CONFIG = LocalizeConfig()
CAMERA = Camera(width=640, height=480, fx_px=420.0, fy_px=425.0, cx_px=318.0, cy_px=241.0)
# Camera axes right, down, forward, looking along x.
AHEAD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
PLACE = pose(0.9, 1.9, 1.5, 0.1, 0.15, -0.4)
TRUTH = SE3(rotation=PLACE.rotation @ AHEAD, translation=PLACE.translation)
FIRST = TRUTH.retract(np.array([0.1, -0.1, 0.15, 0.2, -0.2, 0.15]))


@pytest.fixture(scope="module")
def room():
    return prepare_map(map_of(noise_m=0.003), CONFIG)


@pytest.fixture(scope="module")
def picture():
    return wireframe_photograph(TRUTH, segments_of(), CAMERA)


def test_all_lines_of_a_photograph_lie_within_its_sides(picture):
    arcs = arcs_of_photograph(picture, CAMERA, CONFIG)
    assert len(arcs) > 20
    slack = np.sin(np.deg2rad(0.2))
    assert (arcs.starts @ arcs.sides.T > -slack).all()
    assert (arcs.ends @ arcs.sides.T > -slack).all()
    corner = np.array([0.5 - 320.0, 0.5 - 240.0, 420.0])
    assert ((corner / np.linalg.norm(corner)) @ arcs.sides.T).min() < 0.02


def test_a_photograph_is_found_from_a_first_pose(room, picture):
    prior = PosePrior(T_world_picture=FIRST)
    result = localize_photograph(picture, CAMERA, [room], CONFIG, prior=prior)
    assert result.status is LocalizationStatus.FOUND
    assert translation_errors_m(result.T_world_panorama, TRUTH) < 0.03
    assert np.degrees(rotation_errors_rad(result.T_world_panorama, TRUTH)) < 0.5


def test_a_photograph_of_nothing_has_too_few_lines(room):
    picture = np.full((480, 640), 90, np.uint8)
    prior = PosePrior(T_world_picture=FIRST)
    result = localize_photograph(picture, CAMERA, [room], CONFIG, prior=prior)
    assert result.reason is NoPoseReason.INSUFFICIENT_LINES


def test_a_photograph_of_another_size_than_the_cameras_is_refused():
    with pytest.raises(InputError, match="640 x 480 pixels, as the camera has, found 320 x 240"):
        arcs_of_photograph(np.zeros((240, 320), np.uint8), CAMERA, CONFIG)
