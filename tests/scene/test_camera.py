import dataclasses

import numpy as np
import pytest

from roel_service.errors import CameraError, PanoramaError
from roel_service.scene.camera import DISTORTION_COUNTS, Camera, CameraModel, Equirectangular

CAMERA = Camera(width=346, height=260, fx_px=200.0, fy_px=205.0, cx_px=170.5, cy_px=130.0)


def test_matrix_holds_the_intrinsics_in_their_places():
    np.testing.assert_array_equal(CAMERA.matrix, [[200, 0, 170.5], [0, 205, 130], [0, 0, 1]])
    assert CAMERA.focal_px == pytest.approx(np.sqrt(200 * 205))


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("width", 0, "width"),
        ("height", -1, "height"),
        ("width", 65536, "width"),
        ("width", 346.0, "width"),
        ("height", True, "height"),
        ("fx_px", 0.0, "fx"),
        ("fy_px", -200.0, "fy"),
        ("fx_px", float("nan"), "fx"),
        ("fy_px", float("inf"), "fy"),
        ("cx_px", float("nan"), "cx"),
        ("cy_px", float("inf"), "cy"),
        ("distortion", (0.1,), "0 or 4 or 5 or 8 distortion coefficients"),
        ("distortion", (0.1, 0.0, 0.0, float("nan")), "finite distortion"),
    ],
)
def test_impossible_calibrations_are_refused_by_name(field, value, expected):
    with pytest.raises(CameraError, match=expected):
        dataclasses.replace(CAMERA, **{field: value})


@pytest.mark.parametrize("model", CameraModel)
def test_each_model_accepts_its_own_coefficient_counts_only(model):
    for count in range(10):
        coefficients = (0.01,) * count
        if count in DISTORTION_COUNTS[model]:
            camera = dataclasses.replace(CAMERA, model=model, distortion=coefficients)
            assert camera.distortion == coefficients
        else:
            with pytest.raises(CameraError, match=f"found {count}"):
                dataclasses.replace(CAMERA, model=model, distortion=coefficients)


def test_principal_point_may_lie_outside_the_image():
    assert dataclasses.replace(CAMERA, cx_px=-20.0).matrix[0, 2] == -20.0


def test_cameras_are_equal_by_value():
    assert dataclasses.replace(CAMERA) == CAMERA
    assert dataclasses.replace(CAMERA, cx_px=1.0) != CAMERA


def test_panorama_covers_the_sphere_once():
    assert Equirectangular(width=2048, height=1024).width == 2048
    for width, height in ((2048, 1000), (0, 0), (-4, -2)):
        with pytest.raises(PanoramaError, match=f"{width} x {height}") as caught:
            Equirectangular(width=width, height=height)
        assert caught.value.reason == "PANORAMA_INVALID"
