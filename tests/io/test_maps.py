import csv
import json

import numpy as np
import pytest
import trimesh

from roel_service.errors import InputError, MapFileError
from roel_service.io.maps import export_map, read_exported_map
from roel_service.io.npz import write_npz
from roel_service.scene.lines import LineMap


@pytest.fixture
def line_map():
    rng = np.random.default_rng(0)
    return LineMap(
        segments=rng.normal(size=(6, 2, 3)) * [1.0, 1e-7, 1e7],
        observation_count=rng.integers(0, 1000, 6),
        rms_residual_px=rng.random(6),
        sigma_m=rng.random(6),
    )


def export(line_map, path):
    export_map(line_map, path)
    return path


def read_lines(line_map, path):
    return export(line_map, path).read_text().splitlines()


def test_npz_holds_the_contract_and_is_read_back(tmp_path, line_map):
    path = export(line_map, tmp_path / "m.npz")
    with np.load(path, allow_pickle=False) as arrays:
        assert {name: (a.dtype.str, a.shape) for name, a in arrays.items()} == {
            "segments": ("<f8", (6, 2, 3)),
            "observation_count": ("<i4", (6,)),
            "rms_residual": ("<f4", (6,)),
            "sigma_m": ("<f4", (6,)),
        }
    back = read_exported_map(path)
    for name in ("segments", "observation_count", "rms_residual_px", "sigma_m"):
        np.testing.assert_array_equal(getattr(back, name), getattr(line_map, name))


def test_json_holds_a_record_a_segment(tmp_path, line_map):
    records = json.loads("\n".join(read_lines(line_map, tmp_path / "m.json")))
    np.testing.assert_array_equal([r["segments"] for r in records], line_map.segments)
    assert [r["observation_count"] for r in records] == line_map.observation_count.tolist()
    assert [r["rms_residual"] for r in records] == line_map.rms_residual_px.tolist()
    assert [r["sigma_m"] for r in records] == line_map.sigma_m.tolist()


def test_csv_holds_a_record_a_line(tmp_path, line_map):
    records = list(csv.DictReader(read_lines(line_map, tmp_path / "m.csv")))
    ends = [[float(r[name]) for name in ("x0", "y0", "z0", "x1", "y1", "z1")] for r in records]
    np.testing.assert_array_equal(np.reshape(ends, (-1, 2, 3)), line_map.segments)
    assert [int(r["observation_count"]) for r in records] == line_map.observation_count.tolist()
    assert [float(r["rms_residual"]) for r in records] == line_map.rms_residual_px.tolist()


def test_ply_holds_vertices_and_edges(tmp_path, line_map):
    header, body = export(line_map, tmp_path / "m.ply").read_text().split("end_header\n")
    assert "element vertex 12" in header
    assert "element edge 6" in header
    rows = [[float(value) for value in line.split()] for line in body.splitlines()]
    vertices = np.array(rows[:12])
    edges = np.array([row[:2] for row in rows[12:]], int)
    np.testing.assert_array_equal(vertices[edges], line_map.segments)
    assert [row[2] for row in rows[12:]] == line_map.observation_count.tolist()


def test_obj_holds_vertices_and_lines(tmp_path, line_map):
    lines = [line.split() for line in read_lines(line_map, tmp_path / "m.obj")]
    vertices = np.array([fields[1:] for fields in lines if fields[0] == "v"], float)
    indices = np.array([fields[1:] for fields in lines if fields[0] == "l"], int)
    np.testing.assert_array_equal(vertices[indices - 1], line_map.segments)


def test_dxf_is_read_by_another_program(tmp_path, line_map):
    drawing = trimesh.load(export(line_map, tmp_path / "m.dxf"))
    assert len(drawing.entities) == len(line_map)
    pairs = (tmp_path / "m.dxf").read_text().split("\n")[:-1]
    values = {code: [] for code in ("10", "20", "30", "11", "21", "31")}
    for code, value in zip(pairs[::2], pairs[1::2], strict=True):
        if code in values:
            values[code].append(float(value))
    ends = np.stack(list(values.values()), axis=1).reshape(-1, 2, 3)
    np.testing.assert_array_equal(ends, line_map.segments)


@pytest.mark.parametrize("suffix", ["npz", "ply", "obj", "json", "csv", "dxf"])
def test_map_without_lines_is_exported(tmp_path, suffix):
    path = export(LineMap.from_segments(np.empty((0, 2, 3))), tmp_path / f"m.{suffix}")
    assert path.exists()
    if suffix == "npz":
        assert len(read_exported_map(path)) == 0


@pytest.mark.parametrize("name", ["m.step", "m", ".npz", "m.npz.gz"])
def test_unknown_suffix_is_refused_and_nothing_written(tmp_path, line_map, name):
    with pytest.raises(InputError, match=r"\.csv, \.dxf, \.json, \.npz, \.obj, \.ply"):
        export_map(line_map, tmp_path / name)
    assert list(tmp_path.iterdir()) == []


def test_map_without_sigma_is_read(tmp_path, line_map):
    write_npz(
        tmp_path / "m.npz",
        segments=line_map.segments,
        observation_count=line_map.observation_count,
        rms_residual=line_map.rms_residual_px,
    )
    assert read_exported_map(tmp_path / "m.npz").sigma_m.tolist() == [0.0] * 6


@pytest.mark.parametrize(
    "changed",
    [
        {"segments": np.zeros((6, 6))},
        {"segments": np.zeros(())},
        {"segments": np.full((6, 2, 3), np.nan)},
        {"observation_count": np.zeros(5, np.int32)},
        {"observation_count": np.full(6, 2**40)},
        {"observation_count": np.full(6, 0.5)},
        {"rms_residual": np.full(6, 1e300)},
        {"rms_residual": np.zeros(6, bool)},
    ],
)
def test_what_is_no_map_is_refused(tmp_path, line_map, changed):
    arrays = {
        "segments": line_map.segments,
        "observation_count": line_map.observation_count,
        "rms_residual": line_map.rms_residual_px,
    }
    write_npz(tmp_path / "m.npz", **(arrays | changed))
    with pytest.raises(MapFileError, match="an exported line map"):
        read_exported_map(tmp_path / "m.npz")
    for name in arrays:
        write_npz(tmp_path / "m.npz", **{key: arrays[key] for key in arrays if key != name})
        with pytest.raises(MapFileError, match=f"no {name}"):
            read_exported_map(tmp_path / "m.npz")
