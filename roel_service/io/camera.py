"""Calibrations: JSON or YAML of this project, ROS `camera_info`, Kalibr, one line of numbers."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import yaml

from roel_service.errors import CameraError
from roel_service.io.files import read_input, whole_file
from roel_service.io.text import parse_rows
from roel_service.scene.camera import DISTORTION_COUNTS, Camera, CameraModel

_KEYS = ("width", "height", "fx", "fy", "cx", "cy", "model", "distortion")
_MAX_BYTES = 1 << 16

_ROS_MODELS = {
    "plumb_bob": CameraModel.PINHOLE,
    "rational_polynomial": CameraModel.PINHOLE,
    "equidistant": CameraModel.FISHEYE,
    "fisheye": CameraModel.FISHEYE,
}
_LINE_COLUMNS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")

_KALIBR_MODELS = {
    "radtan": CameraModel.PINHOLE,
    "none": CameraModel.PINHOLE,
    "equidistant": CameraModel.FISHEYE,
}


class _NumberLoader(yaml.BaseLoader):
    """YAML in which a value is text or a decimal number: no dates, octals or sexagesimals."""


_NumberLoader.add_implicit_resolver(
    "!number", re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"), list("-+.0123456789")
)
_NumberLoader.add_constructor("!number", lambda loader, node: float(node.value))


def read_camera(path: Path, sensor_size: tuple[int, int] | None = None) -> Camera:
    """Read a calibration in any of the formats of this module, told by content.

    Args:
        path: JSON or YAML with the keys of `write_camera`, ROS `camera_info` YAML, Kalibr
            `camchain` YAML (its `cam0`), or one line `fx fy cx cy [k1 k2 p1 p2 [k3]]`.
        sensor_size: width and height in px: needed for the line, which carries none; otherwise it
            has to agree with the file.

    Raises:
        InputError: no readable file.
        CameraError: a key is missing, unknown or of a wrong value, or the sensor size is not known
            or another one.
    """
    subject = str(path)
    text = read_input(path, _MAX_BYTES)
    try:
        camera = _parse(text, sensor_size, subject)
    except CameraError as error:
        # The type knows what is wrong; which file it came from is known here.
        raise CameraError(subject, error.expected, error.found) from error
    if sensor_size is not None and (camera.width, camera.height) != sensor_size:
        expected = "a sensor of {}x{}".format(*sensor_size)
        raise CameraError(subject, expected, f"{camera.width}x{camera.height}")
    return camera


def write_camera(path: Path, camera: Camera) -> None:
    """Write the JSON form; reading it again gives an equal camera."""
    values = (
        camera.width,
        camera.height,
        camera.fx_px,
        camera.fy_px,
        camera.cx_px,
        camera.cy_px,
        camera.model.value,
        list(camera.distortion),
    )
    with whole_file(path) as temporary:
        temporary.write_text(json.dumps(dict(zip(_KEYS, values, strict=True))) + "\n")


def _parse(text: bytes, sensor_size: tuple[int, int] | None, subject: str) -> Camera:
    document = _document(text, subject)
    if not isinstance(document, dict):
        return _camera_from_line(text, sensor_size, subject)
    if "camera_matrix" in document:
        return _camera_from_ros(document)
    if "cam0" in document:
        return _camera_from_kalibr(_mapping(document, "cam0"))
    return _camera_from_keys(document)


def _document(text: bytes, subject: str) -> Any:
    """The JSON or YAML document; text that is neither is what it is, a string or number."""
    try:
        if text.lstrip()[:1] == b"{":
            return json.loads(text)
        return yaml.load(text.decode(), Loader=_NumberLoader)
    except (ValueError, TypeError, yaml.YAMLError, RecursionError) as error:
        found = str(error) or type(error).__name__
        raise CameraError(subject, "JSON, YAML or one line of numbers", found) from error


def _camera_from_keys(document: Mapping[str, Any]) -> Camera:
    for key in document:
        if key not in _KEYS:
            raise CameraError("camera", f"no keys but {', '.join(_KEYS)}", f"{key!r}")
    fx, fy, cx, cy = (_number(document, key) for key in ("fx", "fy", "cx", "cy"))
    return Camera(
        width=_integer(document, "width"),
        height=_integer(document, "height"),
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        model=_model(document, "model", {model.value: model for model in CameraModel}),
        distortion=_numbers(document, "distortion"),
    )


def _camera_from_ros(document: Mapping[str, Any]) -> Camera:
    matrix = _numbers(_mapping(document, "camera_matrix"), "data")
    if len(matrix) != 9:
        raise CameraError("camera", "9 values camera_matrix.data", f"{len(matrix)}")
    model = _model(document, "distortion_model", _ROS_MODELS)
    distortion = _numbers(_mapping(document, "distortion_coefficients"), "data")
    return Camera(
        width=_integer(document, "image_width"),
        height=_integer(document, "image_height"),
        fx_px=matrix[0],
        fy_px=matrix[4],
        cx_px=matrix[2],
        cy_px=matrix[5],
        model=model,
        distortion=_without_unused_zeros(distortion, model),
    )


def _camera_from_kalibr(document: Mapping[str, Any]) -> Camera:
    _model(document, "camera_model", {"pinhole": CameraModel.PINHOLE})
    intrinsics = _numbers(document, "intrinsics")
    resolution = _numbers(document, "resolution")
    if len(intrinsics) != 4 or len(resolution) != 2:
        found = f"{len(intrinsics)} and {len(resolution)}"
        raise CameraError("camera", "4 intrinsics and 2 values resolution", found)
    fx, fy, cx, cy = intrinsics
    model = _model(document, "distortion_model", _KALIBR_MODELS)
    return Camera(
        width=_whole(resolution[0], "resolution"),
        height=_whole(resolution[1], "resolution"),
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        model=model,
        distortion=_numbers(document, "distortion_coeffs"),
    )


def _camera_from_line(text: bytes, sensor_size: tuple[int, int] | None, subject: str) -> Camera:
    count = max(4, min(len(text.split()), 12))
    columns = " ".join(_LINE_COLUMNS[:count])
    rows = parse_rows(text, columns, 1, subject, CameraError)
    if len(rows) != 1:
        raise CameraError(subject, f"one line {columns}", f"{len(rows)} lines")
    if sensor_size is None:
        expected = "--sensor-size WIDTHxHEIGHT beside a calibration without a sensor size"
        raise CameraError(subject, expected, "none")
    fx, fy, cx, cy, *distortion = rows[0].tolist()
    return Camera(
        width=sensor_size[0],
        height=sensor_size[1],
        fx_px=fx,
        fy_px=fy,
        cx_px=cx,
        cy_px=cy,
        distortion=tuple(distortion),
    )


def _without_unused_zeros(distortion: tuple[float, ...], model: CameraModel) -> tuple[float, ...]:
    """Drop zeros behind the largest number of coefficients that the model has."""
    largest = max(DISTORTION_COUNTS[model])
    return distortion if any(distortion[largest:]) else distortion[:largest]


def _value(document: Mapping[str, Any], key: str) -> Any:
    if key not in document:
        raise CameraError("camera", f"a key {key}", "none")
    return document[key]


def _mapping(document: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    value = _value(document, key)
    if not isinstance(value, dict):
        raise CameraError("camera", f"{key} as a table of keys", _shown(value))
    return value


def _number(document: Mapping[str, Any], key: str) -> float:
    return _float(_value(document, key), key)


def _numbers(document: Mapping[str, Any], key: str) -> tuple[float, ...]:
    value = _value(document, key)
    if not isinstance(value, list):
        raise CameraError("camera", f"{key} as a list of numbers", _shown(value))
    return tuple(_float(entry, key) for entry in value)


def _integer(document: Mapping[str, Any], key: str) -> int:
    return _whole(_number(document, key), key)


def _whole(value: float, key: str) -> int:
    if not value.is_integer():
        raise CameraError("camera", f"{key} a positive integer", f"{value!r}")
    return int(value)


def _float(value: Any, key: str) -> float:
    if isinstance(value, int | float) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise CameraError("camera", f"{key} as finite numbers", _shown(value))


def _model(document: Mapping[str, Any], key: str, models: Mapping[str, CameraModel]) -> CameraModel:
    value = _value(document, key)
    if not isinstance(value, str) or value not in models:
        raise CameraError("camera", f"{key} one of {', '.join(models)}", _shown(value))
    return models[value]


def _shown(value: object) -> str:
    return repr(value)[:80]
