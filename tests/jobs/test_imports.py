import hashlib

import numpy as np
import pytest

from roel_service.errors import MapFileError
from roel_service.io.maps import export_map
from roel_service.jobs.exports import ExportParameters, run_export
from roel_service.jobs.imports import ImportParameters, run_import
from roel_service.progress import ignore
from roel_service.scene.lines import LineMap
from roel_service.wire.provenance import Provenance
from roel_service.wire.rlm import decode_map, encode_map

SEGMENTS = np.array([[[0.0, 0, 0], [1, 2, 3]], [[1.0, 1, 1], [2, 1, 1]], [[1.0, 1, 1], [1, 1, 1]]])
LINES = LineMap.from_segments(SEGMENTS)


def imported(path):
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return run_import(ImportParameters(file=path, sha256=sha256), ignore)


def test_a_map_file_stays_as_it_is(tmp_path):
    data = encode_map(LINES, Provenance(config_digest="sha256:12"))
    (tmp_path / "file").write_bytes(data)
    version = imported(tmp_path / "file")
    assert version.rlm_bytes == data
    assert version.provenance["config_digest"] == "sha256:12"
    assert version.imported_file["format"] == "rlm"


def test_lines_from_elsewhere_become_a_map_file(tmp_path):
    export_map(LINES, tmp_path / "lines.csv")
    version = imported(tmp_path / "lines.csv")
    assert version.line_count == len(decode_map(version.rlm_bytes).line_map) == 2
    assert np.allclose(version.bounds_m, [0, 0, 0, 2, 2, 3], atol=0.5e-3)
    assert version.report == {}
    assert version.imported_file == {
        "sha256": hashlib.sha256((tmp_path / "lines.csv").read_bytes()).hexdigest(),
        "size_bytes": (tmp_path / "lines.csv").stat().st_size,
        "format": "csv",
        "dropped_line_count": 1,
    }


@pytest.mark.parametrize("data", [b"hello", encode_map(LINES, Provenance())[:-1]])
def test_what_is_no_map_is_refused(tmp_path, data):
    (tmp_path / "file").write_bytes(data)
    with pytest.raises(MapFileError, match="imported file"):
        imported(tmp_path / "file")


def test_a_map_without_lines_is_refused(tmp_path):
    (tmp_path / "file").write_bytes(encode_map(LineMap.from_segments(SEGMENTS[2:]), Provenance()))
    with pytest.raises(MapFileError, match="expected lines, found none"):
        imported(tmp_path / "file")


def test_an_export_is_what_the_command_line_writes(tmp_path):
    data = encode_map(LINES, Provenance())
    (tmp_path / "map").write_bytes(data)
    target = tmp_path / "map.ply"
    run_export(ExportParameters(map_file=tmp_path / "map", target=target), ignore)
    export_map(decode_map(data).line_map, tmp_path / "expected.ply")
    assert target.read_bytes() == (tmp_path / "expected.ply").read_bytes()
