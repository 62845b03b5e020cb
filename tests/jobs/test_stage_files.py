import numpy as np
import pytest

from roel_service.config.stages import DetectConfig
from roel_service.jobs import stage_files
from roel_service.jobs.stage_files import StageFiles

FOUND = {"t_us": np.arange(5), "forms": np.linspace(0.0, 1.0, 12).reshape(3, 4)}


@pytest.fixture
def files(tmp_path):
    return StageFiles(tmp_path / "cache", "recording", 10_000)


def stored(tmp_path):
    return sorted((tmp_path / "cache").iterdir())


def test_what_was_kept_is_found_bit_by_bit(files):
    files.keep("detect", DetectConfig(), FOUND)
    found = files.get("detect", DetectConfig())
    assert set(found) == set(FOUND)
    for name, array in FOUND.items():
        assert found[name].dtype == array.dtype
        np.testing.assert_array_equal(found[name], array)


def test_another_stage_parameter_recording_or_code_finds_nothing(files, tmp_path, monkeypatch):
    files.keep("detect", DetectConfig(), FOUND)
    assert files.get("refine", DetectConfig()) is None
    assert files.get("detect", DetectConfig(min_length_px=7.25)) is None
    assert StageFiles(tmp_path / "cache", "other", 10_000).get("detect", DetectConfig()) is None
    monkeypatch.setattr(stage_files, "code_digest", lambda: "changed")
    assert files.get("detect", DetectConfig()) is None


def test_a_damaged_entry_is_no_entry(files, tmp_path):
    files.keep("detect", None, FOUND)
    path = stored(tmp_path)[0]
    path.write_bytes(path.read_bytes()[:-1])
    assert files.get("detect", None) is None


def test_what_was_not_used_for_the_longest_time_makes_room(tmp_path):
    noise = {"noise": np.random.default_rng(0).random(400)}
    files = StageFiles(tmp_path / "cache", "recording", 8000)
    files.keep("first", None, noise)
    files.keep("second", None, noise)
    assert files.get("first", None) is not None
    files.keep("third", None, noise)
    kept = [stage for stage in ("first", "second", "third") if files.get(stage, None) is not None]
    assert kept == ["first", "third"]
    assert sum(path.stat().st_size for path in stored(tmp_path)) <= 8000
