import cv2
import numpy as np
import pytest

from roel_service.scene.events import EventStream
from roel_service.wire.preview import EventPicture


def drawn(width, height, *pixels):
    """The picture of events (x, y, polarity), as OpenCV reads it: rows, columns, RGB."""
    x, y, polarity = (np.array(column) for column in zip(*pixels, strict=True))
    events = EventStream(
        t_us=np.arange(len(x)), x=x, y=y, polarity=polarity, width=width, height=height
    )
    picture = EventPicture(width, height)
    for start in range(0, len(x), 2):
        picture.add(events.slice(start, start + 2, 0))
    image = cv2.imdecode(np.frombuffer(picture.png(), np.uint8), cv2.IMREAD_COLOR)
    return image[..., ::-1]


def test_colours_tell_the_polarity_and_brightness_the_number():
    picture = drawn(5, 3, *[(4, 0, 1)] * 9, *[(0, 2, -1)] * 3, (1, 1, 1), (1, 1, -1))
    assert (picture[0, 4, 0], picture[0, 4, 2]) == (163, 0)
    assert (picture[2, 0, 0], picture[2, 0, 2]) == (0, 54)
    assert picture[1, 1, 0] == picture[1, 1, 2] == 36
    assert picture.sum() == 163 + 54 + 2 * 36


@pytest.mark.parametrize(("width", "height"), [(2561, 7), (7, 1281), (65_535, 65_535)])
def test_a_large_sensor_is_shrunk(width, height):
    picture = drawn(width, height, (width - 1, height - 1, 1))
    assert max(picture.shape[:2]) <= 1280
    assert picture[-1, -1, 0] > 0


def test_no_event_is_a_black_picture():
    image = cv2.imdecode(np.frombuffer(EventPicture(6, 4).png(), np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (4, 6, 3)
    assert not image.any()
