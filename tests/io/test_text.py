import contextlib
import io

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.errors import EventsError
from roel_service.io.text import (
    MAX_TIME_US,
    line_blocks,
    line_of_row,
    parse_rows,
    us_from_seconds,
)


def rows(text, columns="a b"):
    return parse_rows(text, columns, 1, "FILE", EventsError)


def test_comments_and_blank_lines_are_skipped():
    text = b"# a b\n\n 1 2 # one\n\t\n3\t4\r\n#5 6"
    np.testing.assert_array_equal(rows(text), [[1, 2], [3, 4]])


@pytest.mark.parametrize("text", [b"", b"\n", b"# only\n  # comments", b" \r\n"])
def test_text_without_data_has_no_rows(text):
    assert rows(text).shape == (0, 2)


@pytest.mark.parametrize(
    ("text", "line", "shown"),
    [
        (b"1 2\n3\n", 2, "'3'"),
        (b"#\n1 2 3\n", 2, "'1 2 3'"),
        (b"1 2\n\n3 x\n", 3, "'3 x'"),
        (b"1 2\n3 nan\n", 2, "'3 nan'"),
        (b"1 2\n-inf 3\n", 2, "'-inf 3'"),
        (b"1 2\n1e999 3\n", 2, "'1e999 3'"),
        (b"\xff\xfe 2\n", 1, "line 1"),
    ],
)
def test_malformed_line_is_named(text, line, shown):
    with pytest.raises(EventsError, match=f"FILE: expected finite numbers a b, .*line {line}") as e:
        rows(text)
    assert shown in str(e.value)


@given(st.binary(max_size=200))
def test_any_bytes_are_rows_or_one_error(text):
    with contextlib.suppress(EventsError):
        assert np.isfinite(rows(text)).all()


@given(st.lists(st.sampled_from([b"1 2", b"", b"# c", b"3 4 # d"])), st.integers(8, 30))
def test_blocks_are_whole_lines_with_their_numbers(lines, size):
    text = b"\n".join(lines)
    blocks = list(line_blocks(io.BytesIO(text), "FILE", EventsError, size))
    assert b"".join(block for _, block in blocks) == text
    for number, block in blocks:
        assert lines[number - 1 : number] == block.split(b"\n")[:1]


def test_endless_line_is_refused():
    with pytest.raises(EventsError, match="longer line 2"):
        list(line_blocks(io.BytesIO(b"1\n" + b"2" * 100), "FILE", EventsError, 16))


def test_row_leads_back_to_its_line():
    text = b"# c\n1 2\n\n3 4\n"
    assert [line_of_row(text, row, 10) for row in (0, 1)] == [11, 13]


@given(st.integers(-MAX_TIME_US + 1, MAX_TIME_US - 1))
def test_six_decimals_give_exact_microseconds(t_us):
    sign, (seconds, fraction) = "-" if t_us < 0 else "", divmod(abs(t_us), 10**6)
    value = float(f"{sign}{seconds}.{fraction:06d}")
    assert us_from_seconds(np.array([value])).tolist() == [t_us]
