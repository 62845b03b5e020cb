import numpy as np
import pytest
from scipy.io import savemat

from roel_bench.recordings import read_aedat2, read_event_lifetime
from roel_service.errors import EventsError, InputError

HEADER = b"#!AER-DAT2.0\r\n# a comment\r\n"


def address(column, row, positive):
    """As a DAVIS240 counts: from the right and from below."""
    return ((179 - row) << 22) | ((239 - column) << 12) | (positive << 11)


def aedat2(path, records, header=HEADER):
    path.write_bytes(header + np.array(records, ">u4").tobytes())
    return path


def test_aedat2_events_come_out_from_the_top_left(tmp_path):
    records = [[address(0, 0, 1), 5], [address(239, 179, 0), 6]]
    events = read_aedat2(aedat2(tmp_path / "a.aedat", records))
    assert (events.width, events.height) == (240, 180)
    assert events.t_us.tolist() == [5, 6]
    assert events.x.tolist() == [0, 239]
    assert events.y.tolist() == [0, 179]
    assert events.polarity.tolist() == [1, -1]


def test_aedat2_leaves_out_what_is_no_event(tmp_path):
    frame_sample = 1 << 31
    trigger = address(3, 4, 1) | (1 << 10)
    records = [[frame_sample, 1], [address(3, 4, 1), 2], [trigger, 3]]
    events = read_aedat2(aedat2(tmp_path / "a.aedat", records))
    assert events.t_us.tolist() == [2]


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"#!AER-DAT3.1\r\n", "#!AER-DAT2.0"),
        (HEADER + bytes(12), "records of 8 bytes"),
        (HEADER, "at least one event"),
        (HEADER[:-2], "at least one event"),
        (HEADER + np.array([[511 << 22, 1]], ">u4").tobytes(), "y in \\[0, 180\\)"),
        (HEADER + np.array([[0, 9], [0, 8]], ">u4").tobytes(), "never decrease"),
    ],
)
def test_other_bytes_are_no_aedat2(tmp_path, content, expected):
    path = tmp_path / "a.aedat"
    path.write_bytes(content)
    with pytest.raises(EventsError, match=expected):
        read_aedat2(path)


def test_event_lifetime_columns(tmp_path):
    path = tmp_path / "a.mat"
    savemat(path, {"events": np.array([[1, 2, 1, 10], [127, 0, -1, 20]], np.int32)})
    events = read_event_lifetime(path)
    assert (events.width, events.height) == (128, 128)
    assert events.x.tolist() == [1, 127]
    assert events.y.tolist() == [2, 0]
    assert events.polarity.tolist() == [1, -1]
    assert events.t_us.tolist() == [10, 20]


@pytest.mark.parametrize(
    "arrays",
    [
        {"other": np.zeros((2, 4), np.int32)},
        {"events": np.zeros((2, 3), np.int32)},
        {"events": np.full((2, 4), 0.5)},
        {"events": np.array([[128, 0, 1, 0]], np.int32)},
        {"events": np.array([[0, 0, 0, 0]], np.int32)},
    ],
)
def test_other_arrays_are_no_event_lifetime(tmp_path, arrays):
    savemat(tmp_path / "a.mat", arrays)
    with pytest.raises(EventsError):
        read_event_lifetime(tmp_path / "a.mat")


def test_files_that_are_not_there_or_no_matlab(tmp_path):
    with pytest.raises(InputError):
        read_aedat2(tmp_path / "none.aedat")
    (tmp_path / "a.mat").write_bytes(b"MATLAB it is not")
    with pytest.raises(EventsError, match="MATLAB"):
        read_event_lifetime(tmp_path / "a.mat")
