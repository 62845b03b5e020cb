import io
import json
import zipfile

import numpy as np
import pytest

from roel_service.errors import MapFileError
from roel_service.io.foreign_maps import FOREIGN_FORMATS, read_foreign_map
from roel_service.io.maps import EXPORT_FORMATS, export_map
from roel_service.scene.lines import LineMap

SEGMENTS = np.array([[[0.1, 0, 0], [1, 1e-3, 0]], [[-2, 3.25, 1], [1 / 3, 0, 7]]])
LINES = LineMap(
    segments=SEGMENTS,
    observation_count=np.array([3, 70_000], np.int32),
    rms_residual_px=np.array([0.25, 0.1], np.float32),
    sigma_m=np.array([0.5, 0.01], np.float32),
)
ALL_TRACKS = "2\n0 3 2\n0.1 0 0\n1 1e-3 0\n5 5 7 \n1 2 3 \n1 2 4\n-2 3.25 1\n0.5 0 7\n1 2\n9 9\n"


@pytest.fixture
def read(tmp_path):
    """Format and lines of some bytes, whose file has a name that tells nothing."""

    def read_bytes(data):
        path = tmp_path / "file"
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
        return read_foreign_map(path, "import")

    return read_bytes


def archive_of(**texts):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in texts.items():
            archive.writestr(f"limap/{name}.txt", text)
    return data.getvalue()


@pytest.mark.parametrize("suffix", EXPORT_FORMATS)
def test_every_export_is_read_back(read, tmp_path, suffix):
    export_map(LINES, tmp_path / f"map.{suffix}")
    name, found = read((tmp_path / f"map.{suffix}").read_bytes())
    assert name == suffix
    assert np.array_equal(found.segments, SEGMENTS)
    known = suffix not in ("obj", "dxf")
    for column in ("observation_count", "rms_residual_px", "sigma_m"):
        expected = getattr(LINES, column) if known else np.zeros(2)
        assert np.array_equal(getattr(found, column), expected)


def test_polylines_and_all_kinds_of_corners_of_obj_are_read(read):
    name, found = read("# a comment\nv 0 0 0\nv 1 0 0\nv 1 1 0 0.5\nl 1 2/7 3\nl -1 -3\nf 1 2 3\n")
    assert name == "obj"
    ends = [[[0, 0, 0], [1, 0, 0]], [[1, 0, 0], [1, 1, 0]], [[1, 1, 0], [0, 0, 0]]]
    assert found.segments.tolist() == ends


def test_only_entities_of_dxf_are_lines(read):
    block = ["0", "LINE", "10", "9", "20", "9", "11", "8"]
    line = ["0", "LINE", "8", "layer", "10", "1", "20", "2", "11", "3", "21", "4.5"]
    circle = ["0", "CIRCLE", "10", "5", "40", "1"]
    groups = ["0", "SECTION", "2", "BLOCKS", *block, "0", "ENDSEC"]
    groups += ["0", "SECTION", "2", "ENTITIES", *line, *circle, "0", "ENDSEC", "0", "EOF"]
    for end in ("\n", "\r\n"):
        name, found = read(end.join(groups))
        assert name == "dxf"
        assert found.segments.tolist() == [[[1, 2, 0], [3, 4.5, 0]]]


@pytest.mark.parametrize("data", [ALL_TRACKS, archive_of(alltracks=ALL_TRACKS)])
def test_limap_tracks_are_read(read, data):
    name, found = read(data)
    assert name == "limap"
    assert found.segments[0].tolist() == SEGMENTS[0].tolist()
    assert found.observation_count.tolist() == [2, 4]


def test_a_folder_of_limap_tracks_is_read_in_the_order_of_numbers(read):
    track = "{} 0 0 1 0 0\n5 {}\nimage_id_list 1 2\n" + "0 " * 5000
    tracks = {f"track_{i}": track.format(i / 4, i) for i in (10, 2)}
    name, found = read(archive_of(**tracks, image_list="other"))
    assert name == "limap"
    assert found.segments[:, 0, 0].tolist() == [0.5, 2.5]
    assert found.observation_count.tolist() == [2, 10]


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"hello",
        b"\x89PNG\r\n",
        b"PK\x03\x04 no archive",
        archive_of(other="text"),
        archive_of(track_0="1 2 3"),
        archive_of(track_0="a b c d e f g h"),
        '[{"segments": [[0, 0, 0]]}]',
        '[{"segments": [[0, 0, 0], [1, 1, NaN]]}]',
        "[1, 2]",
        "[" * 100_000,
        "x0,y0,z0,x1,y1\n1,2,3,4,5\n",
        "x0,y0,z0,x1,y1,z1\n1,2,3,4,5\n",
        "x0,y0,z0,x1,y1,z1,observation_count\n1,2,3,4,5,6,0.5\n",
        "v 0 0 0\nl 1 2\n",
        "v 0 0 0\nl 0 1\n",
        "v 0 0 zero\n",
        "ply\nformat ascii 1.0\nelement vertex 0\nend_header\n",
        "0\nSECTION\n2\nENTITIES\n0\nLINE\n10\nx\n",
        "0\nSECTION\nx\ny\n",
        "2\n0 1 1 0 0 0 1 1 1 5 5\n",
        "1\n0 1 1 0 0 0 1 1 1 5 5 6\n",
        "999999999999\n0 -5 1 0 0 0 0 0 0\n",
    ],
)
def test_anything_else_is_refused_in_one_line(read, data):
    with pytest.raises(MapFileError) as caught:
        read(data)
    assert (caught.value.subject, caught.value.reason) == ("import", "MAP_FILE_INVALID")


def test_json_with_integers_alone_is_read(read):
    record = {"segments": [[0, 0, 0], [1, 0, 0]], "observation_count": 4}
    _, found = read(json.dumps([record]))
    assert found.observation_count.tolist() == [4]
    assert found.sigma_m.tolist() == [0.0]


def test_the_formats_are_those_that_can_be_told(read):
    assert set(FOREIGN_FORMATS) == {*EXPORT_FORMATS, "limap"}
