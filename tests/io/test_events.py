import contextlib

import h5py
import hdf5plugin
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.errors import EventsError, InputError
from roel_service.io import event_columns
from roel_service.io.events import open_events, read_events, write_events_hdf5
from roel_service.io.text import MAX_TIME_US
from roel_service.scene.events import EventStream

from .recordings import (
    HEIGHT,
    WIDTH,
    WRITERS,
    assert_same_events,
    columns,
    stream,
    write_hdf5,
    write_npz,
    write_text,
)

formats = pytest.mark.parametrize("suffix", WRITERS)


def read(path):
    return read_events(path, WIDTH, HEIGHT)


def refused(path, reason="EVENTS_INVALID"):
    """The message of the one error that reading the file gives."""
    with pytest.raises(EventsError) as caught:
        read(path)
    assert caught.value.reason == reason
    assert str(caught.value).startswith(f"{path}: expected ")
    assert "\n" not in str(caught.value)
    return str(caught.value)


@formats
def test_every_format_gives_the_same_events(tmp_path, suffix):
    raw = columns(500)
    # The suffix says nothing: formats are told by content.
    with open(tmp_path / "recording", "wb") as file:
        WRITERS[suffix](file.name, raw) if suffix != "npz" else write_npz(file, raw)
    assert_same_events(read(tmp_path / "recording"), stream(raw))


@formats
def test_time_range_is_known_before_reading(tmp_path, suffix):
    raw = columns(500)
    WRITERS[suffix](tmp_path / f"e.{suffix}", raw)
    expected = stream(raw)
    source = open_events(tmp_path / f"e.{suffix}", WIDTH, HEIGHT)
    assert source.time_range_us == (expected.t_us[0], expected.t_us[-1])


@formats
def test_negative_polarity_may_be_minus_one(tmp_path, suffix):
    raw = columns(50)
    signed = raw | {"p": np.where(raw["p"] == 1, 1, -1)}
    WRITERS[suffix](tmp_path / f"e.{suffix}", signed)
    assert_same_events(read(tmp_path / f"e.{suffix}"), stream(raw))


@formats
def test_events_larger_than_a_chunk_arrive_in_chunks(tmp_path, suffix, monkeypatch):
    raw = columns(1000)
    WRITERS[suffix](tmp_path / f"e.{suffix}", raw)
    pieces = event_columns.EventColumns.pieces
    monkeypatch.setattr(
        event_columns.EventColumns, "pieces", lambda self, size=64: pieces(self, size)
    )
    source = open_events(tmp_path / f"e.{suffix}", WIDTH, HEIGHT)
    sizes = [len(chunk) for chunk in source.chunks()]
    assert max(sizes) <= 64
    assert sum(sizes) == 1000
    # A source may be read again.
    assert sum(len(chunk) for chunk in source.chunks()) == 1000
    assert_same_events(read(tmp_path / f"e.{suffix}"), stream(raw))


@formats
@pytest.mark.parametrize(
    ("name", "value", "reason", "message"),
    [
        ("t", 0, "EVENT_TIME_NOT_MONOTONE", "a decrease at event 77"),
        ("x", WIDTH, "EVENT_OUT_OF_BOUNDS", f"x = {WIDTH} at event 77"),
        ("y", HEIGHT, "EVENT_OUT_OF_BOUNDS", f"y = {HEIGHT} at event 77"),
        ("x", -1, "EVENT_OUT_OF_BOUNDS", "x = -1 at event 77"),
        ("p", 2, "EVENT_POLARITY_INVALID", "2 at event 77"),
        ("p", -1, "EVENT_POLARITY_INVALID", "-1 at event 77"),
    ],
)
def test_wrong_event_is_named_by_its_index(tmp_path, suffix, name, value, reason, message):
    raw = columns(100, start_us=1000)
    raw["p"][0] = 0
    raw[name][77] = value
    WRITERS[suffix](tmp_path / f"e.{suffix}", raw)
    assert message in refused(tmp_path / f"e.{suffix}", reason)


@formats
def test_index_of_a_wrong_event_counts_over_chunks(tmp_path, suffix, monkeypatch):
    pieces = event_columns.EventColumns.pieces
    monkeypatch.setattr(
        event_columns.EventColumns, "pieces", lambda self, size=10: pieces(self, size)
    )
    for index in (10, 25):  # the border of two chunks, and inside one
        raw = columns(30, start_us=1000, step_us=2)
        raw["t"][index:] -= 500
        WRITERS[suffix](tmp_path / f"{index}.{suffix}", raw)
        message = refused(tmp_path / f"{index}.{suffix}", "EVENT_TIME_NOT_MONOTONE")
        assert f"a decrease at event {index}" in message


@formats
def test_recording_without_events_is_refused(tmp_path, suffix):
    WRITERS[suffix](tmp_path / f"e.{suffix}", columns(0))
    refused(tmp_path / f"e.{suffix}", "NO_EVENTS")


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_columns_have_to_be_four_integer_vectors_of_one_length(tmp_path, suffix):
    path = tmp_path / f"e.{suffix}"
    raw = columns(10)
    for changed, message in (
        ({"x": raw["x"][:9]}, "equal length"),
        ({"y": raw["y"] + 0.5}, "y with 1 dimension of integers"),
        ({"t": raw["t"].reshape(2, 5)}, "t with 1 dimension of integers"),
    ):
        WRITERS[suffix](path, raw | changed)
        assert message in refused(path)
    WRITERS[suffix](path, {name: raw[name] for name in "txy"})
    assert "p" in refused(path)


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_columns_of_any_integer_type_and_byte_order_are_read(tmp_path, suffix):
    raw = columns(100)
    dtypes = {"t": ">u8", "x": "i1", "y": ">u4", "p": "?"}
    typed = {name: raw[name].astype(dtype) for name, dtype in dtypes.items()}
    WRITERS[suffix](tmp_path / f"e.{suffix}", typed)
    assert_same_events(read(tmp_path / f"e.{suffix}"), stream(raw))


@pytest.mark.parametrize("suffix", ["h5", "npz"])
def test_times_beyond_the_exact_range_are_refused(tmp_path, suffix):
    raw = columns(10)
    for value in (MAX_TIME_US + 1, 2**62):
        raw["t"][-1] = value
        WRITERS[suffix](tmp_path / f"e.{suffix}", raw)
        assert f"{value} us" in refused(tmp_path / f"e.{suffix}")


@pytest.mark.parametrize("suffix", ["h5", "npz"])
@given(data=st.data())
@settings(max_examples=60, deadline=None)
def test_damaged_bytes_give_an_input_error_or_valid_events(tmp_path_factory, suffix, data):
    folder = tmp_path_factory.mktemp("damage")
    path = folder / f"e.{suffix}"
    WRITERS[suffix](path, columns(40))
    content = bytearray(path.read_bytes())
    if data.draw(st.booleans()):
        del content[data.draw(st.integers(0, len(content) - 1)) :]
    else:
        for _ in range(data.draw(st.integers(1, 4))):
            content[data.draw(st.integers(0, len(content) - 1))] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    # HDF5 protects these bytes by no checksum: values may change, a promise is never broken.
    with contextlib.suppress(InputError):
        assert isinstance(read(path), EventStream)


class TestText:
    def test_decimal_point_in_the_first_column_means_seconds(self, tmp_path):
        path = tmp_path / "e.txt"
        path.write_text("0.000001 1 2 0\n1.5e0 3 4 1\n2 5 6 1\n")
        assert read(path).t_us.tolist() == [1, 1_500_000, 2_000_000]

    def test_integers_alone_mean_microseconds(self, tmp_path):
        path = tmp_path / "e.txt"
        path.write_text("# 0.5 in a comment\n1 1 2 0\n15 3 4 1\n")
        assert read(path).t_us.tolist() == [1, 15]

    def test_unit_may_show_after_the_first_line(self, tmp_path):
        path = tmp_path / "e.txt"
        path.write_text("0 1 2 0\n0.25 3 4 1\n")
        assert read(path).t_us.tolist() == [0, 250_000]

    def test_seconds_are_exact_at_epoch_times(self, tmp_path):
        raw = columns(200, start_us=1_700_000_000_123_457, step_us=3)
        write_text(tmp_path / "s.txt", raw)
        write_text(tmp_path / "us.txt", raw, unit="us")
        assert_same_events(read(tmp_path / "s.txt"), stream(raw))
        assert_same_events(read(tmp_path / "us.txt"), stream(raw))

    @pytest.mark.parametrize(
        ("line", "message"),
        [
            ("0.5 1 2", "'0.5 1 2' in line 3"),
            ("0.5 1 2 0 7", "line 3"),
            ("0.5 1 two 0", "line 3"),
            ("nan 1 2 0", "line 3"),
            ("0.5 1.5 2 0", "line 3"),
            ("0.5 1e300 2 0", "line 3"),
            ("1e308 1 2 0", "line 3"),
        ],
    )
    def test_malformed_line_is_named(self, tmp_path, line, message):
        path = tmp_path / "e.txt"
        path.write_text(f"# t x y p\n0.1 1 2 0\n{line}\n")
        assert message in refused(path)

    @given(st.binary(max_size=100))
    @settings(deadline=None)
    def test_any_bytes_are_refused_or_valid(self, tmp_path_factory, content):
        path = tmp_path_factory.mktemp("text") / "e"
        path.write_bytes(content)
        with contextlib.suppress(InputError):
            assert len(read(path)) > 0

    def test_comments_at_both_ends_do_not_hide_the_time_range(self, tmp_path):
        lines = ["# t x y p", "", "0.5 1 1 0", "0.75 2 2 1", "# the end", ""]
        (tmp_path / "e.txt").write_text("\n".join(lines))
        source = open_events(tmp_path / "e.txt", WIDTH, HEIGHT)
        assert source.event_count is None
        assert source.time_range_us == (500_000, 750_000)

    def test_time_range_of_malformed_lines_is_unknown(self, tmp_path):
        (tmp_path / "e.txt").write_text("0.5 1 1\n0.6 1 1\n")
        assert open_events(tmp_path / "e.txt", WIDTH, HEIGHT).time_range_us is None


class TestHdf5:
    @pytest.mark.parametrize(
        "storage",
        [
            {},
            {"chunks": (7,), "compression": "gzip"},
            {"chunks": (300,), "maxshape": (None,), **hdf5plugin.Blosc(cname="zstd")},
            {"chunks": (64,), **hdf5plugin.Zstd()},
            {"chunks": (64,), **hdf5plugin.LZ4()},
            {"chunks": (64,), "fletcher32": True, "shuffle": True},
        ],
    )
    def test_storage_does_not_matter(self, tmp_path, storage):
        raw = columns(200)
        write_hdf5(tmp_path / "e.h5", raw, **storage)
        assert_same_events(read(tmp_path / "e.h5"), stream(raw))

    @pytest.mark.parametrize("t_offset", [np.int64(-1234), np.uint32(10**9), [55]])
    def test_offset_moves_every_time(self, tmp_path, t_offset):
        raw = columns(20)
        write_hdf5(tmp_path / "e.h5", raw, t_offset=t_offset)
        expected = stream(raw, t_offset_us=int(np.ravel(t_offset)[0]))
        source = open_events(tmp_path / "e.h5", WIDTH, HEIGHT)
        assert_same_events(read(tmp_path / "e.h5"), expected)
        assert source.event_count == 20
        assert source.time_range_us == (expected.t_us[0], expected.t_us[-1])

    @pytest.mark.parametrize("t_offset", [0.5, [1, 2], "now", 2**62])
    def test_offset_has_to_be_one_integer(self, tmp_path, t_offset):
        write_hdf5(tmp_path / "e.h5", columns(5), t_offset=t_offset)
        assert "t_offset as one integer" in refused(tmp_path / "e.h5")

    def test_truncated_file_is_refused(self, tmp_path):
        path = tmp_path / "e.h5"
        write_hdf5(path, columns(5000), chunks=(100,), compression="gzip")
        content = path.read_bytes()
        for size in (9, 100, 2000, len(content) // 2, len(content) - 1):
            path.write_bytes(content[:size])
            assert "undamaged HDF5 file" in refused(path)

    def test_damaged_chunk_is_refused(self, tmp_path):
        path = tmp_path / "e.h5"
        write_hdf5(path, columns(5000), chunks=(1000,), fletcher32=True)
        with h5py.File(path) as file:
            chunk = file["events/x"].id.get_chunk_info(2)
        content = bytearray(path.read_bytes())
        content[chunk.byte_offset + 10] ^= 1
        path.write_bytes(content)
        assert "undamaged HDF5 file" in refused(path)

    def test_unknown_filter_is_named(self, tmp_path):
        path = tmp_path / "e.h5"
        with h5py.File(path, "w") as file:
            for name, values in columns(10).items():
                properties = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
                properties.set_chunk((10,))
                if name == "y":
                    # An optional filter that nobody has: written without, recorded all the same.
                    properties.set_filter(333, h5py.h5z.FLAG_OPTIONAL, (1,))
                space = h5py.h5s.create_simple((10,))
                group = file.require_group("events").id
                dataset = h5py.h5d.create(
                    group, name.encode(), h5py.h5t.STD_I64LE, space, properties
                )
                h5py.Dataset(dataset)[...] = values
        assert "filter 333" in refused(path, "UNSUPPORTED_HDF5_FILTER")

    def test_claim_beyond_the_stored_bytes_is_refused_at_once(self, tmp_path):
        path = tmp_path / "e.h5"
        with h5py.File(path, "w") as file:
            for name in "txyp":
                file.create_dataset(f"events/{name}", (10**12,), "i8", chunks=(1000,))
        assert "a claim of" in refused(path)

    def test_claim_of_a_huge_chunk_is_refused_at_once(self, tmp_path):
        path = tmp_path / "e.h5"
        with h5py.File(path, "w") as file:
            for name in "txyp":
                file.create_dataset(
                    f"events/{name}", (10,), "i8", chunks=(2**28,), maxshape=(None,)
                )
        assert "a claim of" in refused(path)

    def test_columns_of_another_file_are_not_followed(self, tmp_path):
        write_hdf5(tmp_path / "other.h5", columns(5))
        with h5py.File(tmp_path / "e.h5", "w") as file:
            for name in "txyp":
                file[f"events/{name}"] = h5py.ExternalLink("other.h5", f"events/{name}")
        assert "a dataset events/t" in refused(tmp_path / "e.h5")

    def test_bytes_of_another_file_are_not_read(self, tmp_path):
        (tmp_path / "secret").write_bytes(bytes(1000))
        with h5py.File(tmp_path / "e.h5", "w") as file:
            for name in "txyp":
                file.create_dataset(
                    f"events/{name}", (10,), "i8", external=[(tmp_path / "secret", 0, 80)]
                )
        assert "stored in the file itself" in refused(tmp_path / "e.h5")

    def test_group_in_place_of_a_column_is_refused(self, tmp_path):
        with h5py.File(tmp_path / "e.h5", "w") as file:
            file.create_group("events/t")
        assert "a dataset events/t" in refused(tmp_path / "e.h5")


class TestWriteHdf5:
    def write(self, path, streams):
        write_events_hdf5(path, iter(streams))

    def test_written_events_are_read_back(self, tmp_path):
        streams = [
            stream(columns(300, start_us=1_700_000_000_123_456)),
            stream(columns(0)),
            stream(columns(300, seed=1, start_us=1_700_000_001_000_000)),
        ]
        self.write(tmp_path / "e.h5", streams)
        back = list(open_events(tmp_path / "e.h5", WIDTH, HEIGHT).chunks())
        np.testing.assert_array_equal(
            np.concatenate([s.t_us for s in back]), np.concatenate([s.t_us for s in streams])
        )

    def test_millisecond_index_leads_to_the_first_event_of_each(self, tmp_path):
        whole = stream(columns(500, start_us=4_321))
        halves = [
            stream({name: values[part] for name, values in columns(500, start_us=4_321).items()})
            for part in (slice(0, 250), slice(250, None))
        ]
        self.write(tmp_path / "e.h5", halves)
        with h5py.File(tmp_path / "e.h5") as file:
            t = file["events/t"][:]
            assert file["t_offset"][()] == 4_000
            index = file["ms_to_idx"][:]
        np.testing.assert_array_equal(t, whole.t_us - 4_000)
        milliseconds = np.arange(t[-1] // 1000 + 2)
        np.testing.assert_array_equal(index, np.searchsorted(t, 1000 * milliseconds))

    def test_equal_events_give_equal_bytes(self, tmp_path):
        for name in ("a.h5", "b.h5"):
            self.write(tmp_path / name, [stream(columns(100))])
        assert (tmp_path / "a.h5").read_bytes() == (tmp_path / "b.h5").read_bytes()

    @pytest.mark.parametrize(
        ("streams", "reason"),
        [
            ([], "NO_EVENTS"),
            ([columns(10, start_us=10**6), columns(10)], "EVENT_TIME_NOT_MONOTONE"),
            ([columns(1), columns(1, start_us=10**12)], "EVENTS_INVALID"),
        ],
    )
    def test_what_is_no_recording_leaves_no_file(self, tmp_path, streams, reason):
        with pytest.raises(EventsError) as caught:
            self.write(tmp_path / "e.h5", map(stream, streams))
        assert caught.value.reason == reason
        assert list(tmp_path.iterdir()) == []
