import cv2
import numpy as np
import pytest

from roel_service.errors import InputError, PanoramaError
from roel_service.io.images import decode_panorama, decode_photograph, read_panorama
from roel_service.scene.camera import Camera


def encoded(suffix, height=256, width=512):
    rng = np.random.default_rng(0)
    picture = cv2.GaussianBlur(rng.integers(0, 255, (height, width, 3), np.uint8), (0, 0), 3)
    return picture, cv2.imencode(suffix, picture)[1].tobytes()


@pytest.mark.parametrize(("suffix", "tolerance"), [(".png", 1), (".jpg", 12)])
def test_pictures_decode_to_grey_whatever_their_name(suffix, tolerance, tmp_path):
    picture, data = encoded(suffix)
    (tmp_path / "pano.dat").write_bytes(data)
    grey = read_panorama(tmp_path / "pano.dat")
    assert grey.dtype == np.uint8
    expected = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    assert np.abs(grey.astype(int) - expected).max() <= tolerance


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize("kept", [0.05, 0.5, 0.98])
def test_a_picture_that_is_cut_off_is_refused(suffix, kept):
    data = encoded(suffix)[1]
    with pytest.raises(PanoramaError) as caught:
        decode_panorama(data[: int(kept * len(data))], "pano")
    assert caught.value.reason == "PANORAMA_INVALID"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
@pytest.mark.parametrize(("height", "width"), [(256, 256), (255, 510), (300, 512), (128, 256)])
def test_other_shapes_are_refused_with_what_was_found(suffix, height, width):
    with pytest.raises(PanoramaError, match=f"found {width} x {height}"):
        decode_panorama(encoded(suffix, height, width)[1], "pano")


def test_a_size_beyond_the_limit_is_refused_before_decoding():
    data = bytearray(encoded(".png")[1])
    data[16:24] = (100_000).to_bytes(4, "big") + (50_000).to_bytes(4, "big")
    with pytest.raises(PanoramaError, match="found 100000 x 50000"):
        decode_panorama(bytes(data), "pano")


@pytest.mark.parametrize(
    "data", [b"", b"hello", b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff", b"GIF89a" * 9]
)
def test_what_is_no_picture_is_refused(data):
    with pytest.raises(PanoramaError, match="expected a JPEG or PNG picture"):
        decode_panorama(data, "pano")


def test_a_damaged_png_is_refused():
    data = bytearray(encoded(".png")[1])
    data[len(data) // 2] ^= 0x55
    with pytest.raises(PanoramaError):
        decode_panorama(bytes(data), "pano")


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError):
        read_panorama(tmp_path / "none.jpg")


def test_a_photograph_has_the_size_of_its_camera():
    camera = Camera(width=40, height=30, fx_px=30.0, fy_px=30.0, cx_px=20.0, cy_px=15.0)
    data = cv2.imencode(".png", np.full((30, 40), 77, np.uint8))[1].tobytes()
    np.testing.assert_array_equal(decode_photograph(data, camera), np.full((30, 40), 77))
    other = cv2.imencode(".png", np.full((40, 30), 77, np.uint8))[1].tobytes()
    with pytest.raises(PanoramaError, match="expected 40 x 30, as its camera has, found 30 x 40"):
        decode_photograph(other, camera)
