import contextlib
import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import CameraError, InputError
from roel_service.io.camera import read_camera, write_camera
from roel_service.scene.camera import Camera, CameraModel

VALUES = {
    "width": 346,
    "height": 260,
    "fx": 238.1,
    "fy": 238.2,
    "cx": 172.5,
    "cy": 129.5,
    "model": "pinhole",
    "distortion": [0.1, -0.2, 0.001, 0.002],
}
EXPECTED = Camera(
    width=346,
    height=260,
    fx_px=238.1,
    fy_px=238.2,
    cx_px=172.5,
    cy_px=129.5,
    distortion=(0.1, -0.2, 0.001, 0.002),
)

YAML = """
# the same keys
width: 346
height: 260
fx: 238.1
fy: 2.382e2
cx: 172.5
cy: 129.5
model: pinhole
distortion: [0.1, -.2, 0.001, 0.002]
"""

ROS = """
image_width: 346
image_height: 260
camera_name: dvs
camera_matrix: {rows: 3, cols: 3, data: [238.1, 0., 172.5, 0., 238.2, 129.5, 0., 0., 1.]}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 4
  data: [0.1, -0.2, 0.001, 0.002]
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""

KALIBR = """
cam0:
  camera_model: pinhole
  intrinsics: [238.1, 238.2, 172.5, 129.5]
  distortion_model: radtan
  distortion_coeffs: [0.1, -0.2, 0.001, 0.002]
  resolution: [346, 260]
  rostopic: /dvs/image_raw
"""

LINE = "238.1 238.2 172.5 129.5 0.1 -0.2 0.001 0.002\n"


def read(tmp_path, text, sensor_size=None):
    path = tmp_path / "camera"
    path.write_text(text)
    return read_camera(path, sensor_size)


def refused(tmp_path, text, sensor_size=None):
    with pytest.raises(CameraError) as caught:
        read(tmp_path, text, sensor_size)
    assert str(caught.value).startswith(f"{tmp_path / 'camera'}: expected ")
    assert "\n" not in str(caught.value)
    assert caught.value.reason == "CAMERA_INVALID"
    return str(caught.value)


@pytest.mark.parametrize("text", [json.dumps(VALUES), YAML, ROS, KALIBR])
def test_format_is_told_by_content(tmp_path, text):
    assert read(tmp_path, text) == EXPECTED
    assert read(tmp_path, text, (346, 260)) == EXPECTED
    assert "a sensor of 240x180, found 346x260" in refused(tmp_path, text, (240, 180))


def test_line_of_numbers_needs_the_sensor_size(tmp_path):
    assert read(tmp_path, LINE, (346, 260)) == EXPECTED
    assert "--sensor-size WIDTHxHEIGHT" in refused(tmp_path, LINE)


@pytest.mark.parametrize("count", [4, 8, 9])
def test_line_may_hold_fewer_or_more_coefficients(tmp_path, count):
    numbers = [*LINE.split(), "0.0"][:count]
    camera = read(tmp_path, " ".join(numbers), (346, 260))
    assert camera.distortion == tuple(float(number) for number in numbers[4:])


@pytest.mark.parametrize("text", ["1 2 3\n", LINE + LINE, "1 2 3 4 5\n", "1 2 3 four", ""])
def test_other_lines_are_refused(tmp_path, text):
    refused(tmp_path, text, (346, 260))


def test_ros_fisheye_and_long_models(tmp_path):
    fisheye = ROS.replace("plumb_bob", "equidistant")
    assert read(tmp_path, fisheye).model is CameraModel.FISHEYE
    padded = ROS.replace("plumb_bob", "rational_polynomial").replace(
        "0.002]", "0.002, 0, 0, 0, 0, 0, 0]"
    )
    assert read(tmp_path, padded).distortion == (*EXPECTED.distortion, 0, 0, 0, 0)
    thin_prism = padded.replace("0, 0, 0]", "0, 0, 0.1]")
    assert "0 or 4 or 5 or 8 distortion coefficients" in refused(tmp_path, thin_prism)


def test_kalibr_models(tmp_path):
    assert read(tmp_path, KALIBR.replace("radtan", "equidistant")).model is CameraModel.FISHEYE
    assert "camera_model one of pinhole" in refused(
        tmp_path, KALIBR.replace("camera_model: pinhole", "camera_model: omni")
    )


@pytest.mark.parametrize("key", VALUES)
def test_missing_key_is_named(tmp_path, key):
    values = {name: value for name, value in VALUES.items() if name != key}
    assert f"a key {key}, found none" in refused(tmp_path, json.dumps(values))


def test_unknown_key_is_named(tmp_path):
    assert "'skew'" in refused(tmp_path, json.dumps(VALUES | {"skew": 0.0}))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("width", 0),
        ("width", 346.5),
        ("height", -1),
        ("height", "260"),
        ("height", True),
        ("height", 10**400),
        ("fx", 0),
        ("fy", float("nan")),
        ("fx", float("inf")),
        ("cx", None),
        ("cy", [1]),
        ("model", "omni"),
        ("model", 3),
        ("distortion", [0.1]),
        ("distortion", 0.1),
        ("distortion", [0.1, 0.2, 0.3, "x"]),
        ("distortion", [0.1, 0.2, 0.3, float("nan")]),
    ],
)
def test_impossible_value_is_named(tmp_path, key, value):
    assert key in refused(tmp_path, json.dumps(VALUES | {key: value}))


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[" * 30_000,
        '{"width": ' * 9_000,
        "a: [1",
        "a: &x [*x]",
        "cam0: 3",
        "camera_matrix: [1]",
        "!!python/object:os.system {}",
        "width: !number [1]",
        "\x00",
        "x" * 70_000,
    ],
)
def test_other_documents_are_refused(tmp_path, text):
    with pytest.raises(InputError):
        read(tmp_path, text, (346, 260))


@given(
    st.one_of(
        st.binary(max_size=80),
        st.text(alphabet="{}[]:,-&*!|>'\"#% \n\tabw0.1e", max_size=60).map(str.encode),
    )
)
@settings(deadline=None)
def test_any_bytes_are_refused_or_a_camera(tmp_path_factory, content):
    path = tmp_path_factory.mktemp("camera") / "c"
    path.write_bytes(content)
    with contextlib.suppress(InputError):
        assert read_camera(path, (346, 260)).width == 346


@given(
    st.tuples(*[st.integers(1, 65_535)] * 2),
    st.tuples(*[st.floats(1e-3, 1e6)] * 2),
    st.tuples(*[st.floats(-1e6, 1e6)] * 2),
    st.lists(st.floats(-10, 10), min_size=8, max_size=8),
    st.sampled_from(
        [("pinhole", 0), ("pinhole", 4), ("pinhole", 5), ("pinhole", 8), ("fisheye", 4)]
    ),
)
@settings(deadline=None)
def test_written_camera_is_read_back(tmp_path_factory, size, focal, centre, distortion, kind):
    model, count = kind
    camera = Camera(
        width=size[0],
        height=size[1],
        fx_px=focal[0],
        fy_px=focal[1],
        cx_px=centre[0],
        cy_px=centre[1],
        model=CameraModel(model),
        distortion=tuple(distortion[:count]),
    )
    path = tmp_path_factory.mktemp("camera") / "c.json"
    write_camera(path, camera)
    assert read_camera(path) == camera
