import dataclasses
import tomllib

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from roel_service.config.load import load_config, read_tables, to_tables, to_toml, with_tables
from roel_service.config.presets import PRESETS, preset
from roel_service.config.stages import (
    CURVE_METHODS,
    DETECTORS,
    MATCH_GLOBAL_METHODS,
    MATCHERS,
    PLANE_FIT_METHODS,
    POSE_METHODS,
    REFINE_LOSSES,
    REFINE_RESIDUALS,
    REPRESENTATIONS,
    TRIANGULATE_GATES,
    TRIM_METHODS,
    Config,
)
from roel_service.errors import ConfigError

CHOICES = {
    "detect.detector": DETECTORS,
    "plane_fit.method": PLANE_FIT_METHODS,
    "match_global.method": MATCH_GLOBAL_METHODS,
    "match_global.matcher": MATCHERS,
    "triangulate.gate": TRIANGULATE_GATES,
    "refine_rounds.residual": REFINE_RESIDUALS,
    "refine_rounds.loss": REFINE_LOSSES,
    "refine.residual": REFINE_RESIDUALS,
    "refine.loss": REFINE_LOSSES,
    "refine.pose_method": POSE_METHODS,
    "trim.method": TRIM_METHODS,
    "curves.method": CURVE_METHODS,
}
RANGES = {
    "localize.max_width_px": (512, 8192),
    "localize.crop_px": (64, 1024),
    "localize.max_hypothesis_count": (1, 5),
    "track.interval_us": (2_000, 100_000),
    "track.max_event_count": (100, 1_000_000),
}


def values_of(path, value):
    """Other values that a parameter accepts, near enough to its default."""
    if path in CHOICES:
        return st.sampled_from(CHOICES[path])
    if path == "detect.representations":
        return st.lists(st.sampled_from(REPRESENTATIONS), min_size=1).map(tuple)
    if path == "detect.window_event_counts":
        return st.lists(st.integers(1, 10**6)).map(tuple)
    if path == "match_global.checkpoint":
        return st.text().filter(str.isprintable)
    if path == "trim.max_foreshortening":
        return st.floats(1.0, 100.0)
    if isinstance(value, bool):
        return st.booleans()
    if isinstance(value, tuple):
        return st.lists(st.floats(1e-6, 10.0), min_size=1).map(tuple)
    if path == "frames.min_half_window_us":
        return st.integers(1, 10_000)
    if path == "frames.max_half_window_us":
        return st.integers(10_000, 100_000)
    if path in RANGES:
        return st.integers(*RANGES[path])
    if isinstance(value, int):
        return st.integers(2, 256)
    return st.floats(0.1, 1.0)


@st.composite
def configs(draw):
    tables = {}
    for table, values in to_tables(Config()).items():
        stage = getattr(Config(), table)
        changed = draw(st.lists(st.sampled_from(list(values)), unique=True, max_size=4))
        changes = {
            name: draw(values_of(f"{table}.{name}", getattr(stage, name))) for name in changed
        }
        tables[table] = dataclasses.replace(stage, **changes)
    return Config(**tables)


def written(tmp_path, text, name="mine.toml"):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    return path


class TestRoundTrip:
    @settings(max_examples=50)
    @given(configs())
    def test_toml_text_reads_back_to_the_same_configuration(self, config):
        assert with_tables(Config(), tomllib.loads(to_toml(config)), subject="text") == config

    @settings(max_examples=50)
    @given(configs())
    def test_tables_of_plain_values_do_so_too(self, config):
        assert with_tables(preset("paper"), to_tables(config), subject="tables") == config

    @pytest.mark.parametrize("name", PRESETS)
    def test_presets_survive_their_own_file(self, tmp_path, name):
        path = written(tmp_path, to_toml(preset(name)))
        assert load_config("default", path) == preset(name)

    def test_every_parameter_is_written(self):
        tables = tomllib.loads(to_toml(Config()))
        assert set(tables) == {item.name for item in dataclasses.fields(Config)}
        for table, values in tables.items():
            stage = getattr(Config(), table)
            assert set(values) == {item.name for item in dataclasses.fields(stage)}


class TestPrecedence:
    def test_a_file_changes_the_preset_and_options_change_both(self, tmp_path):
        path = written(tmp_path, "[frames]\nrate_hz = 12.5\n[refine]\niteration_count = 3\n")
        config = load_config("paper", path, {"refine": {"iteration_count": 4}})
        assert config.frames.rate_hz == 12.5
        assert config.refine.iteration_count == 4
        assert config.triangulate == preset("paper").triangulate

    def test_without_changes_it_is_the_preset(self):
        assert load_config("paper") == preset("paper")

    def test_lists_become_tuples_and_integers_floats(self):
        tables = {"detect": {"window_events_per_pixel": [1, 2.5]}, "frames": {"rate_hz": 10}}
        config = with_tables(Config(), tables, subject="options")
        assert config.detect.window_events_per_pixel == (1.0, 2.5)
        assert isinstance(config.frames.rate_hz, float)

    def test_the_original_is_left_as_it_was(self):
        config = Config()
        with_tables(config, {"frames": {"rate_hz": 10.0}}, subject="options")
        assert config == Config()


class TestErrors:
    @pytest.mark.parametrize(
        ("text", "message"),
        [
            ("[frame]\nrate_hz = 1.0", "mine.toml: expected one of frames, found frame"),
            (
                "[frames]\nrate = 1.0",
                "mine.toml: expected one of frames.rate_hz, found frames.rate",
            ),
            ("frames = 3", r"mine.toml: expected \[frames\] as a table, found frames = 3"),
            (
                "[frames]\nrate_hz = 'fast'",
                "mine.toml: expected frames.rate_hz of type float, found 'fast'",
            ),
            (
                "[frames]\nrate_hz = true",
                "mine.toml: expected frames.rate_hz of type float, found True",
            ),
            (
                "[frames]\nslot_us = 1.5",
                "mine.toml: expected frames.slot_us of type int, found 1.5",
            ),
            (
                "[frames]\nslot_us = true",
                "mine.toml: expected frames.slot_us of type int, found True",
            ),
            (
                "[match_local]\npredict = 1",
                "mine.toml: expected match_local.predict of type bool, found 1",
            ),
            (
                "[detect]\nrepresentations = 'binary'",
                "mine.toml: expected detect.representations as a list, found 'binary'",
            ),
            (
                "[detect]\nrepresentations = [1]",
                "mine.toml: expected detect.representations of type str, found 1",
            ),
            (
                "[detect]\nwindow_event_counts = [1.5]",
                "mine.toml: expected detect.window_event_counts of type int, found 1.5",
            ),
            (
                "[frames]\nrate_hz = -1",
                "mine.toml: expected frames.rate_hz > 0 and <= 1000, found -1.0",
            ),
            (
                "[frames]\nrate_hz = nan",
                "mine.toml: expected frames.rate_hz > 0 and <= 1000, found nan",
            ),
            (
                "[detect]\ndetector = 'hough'",
                "mine.toml: expected detect.detector one of edlines, lsd, found 'hough'",
            ),
            ("[frames\nrate_hz = 1", "mine.toml: expected a readable TOML file, found"),
        ],
    )
    def test_the_message_names_file_parameter_expected_and_found(self, tmp_path, text, message):
        with pytest.raises(ConfigError, match=message):
            load_config("default", written(tmp_path, text))

    def test_an_unknown_key_without_a_near_one_lists_all(self):
        with pytest.raises(ConfigError, match=r"runtime\.seed, runtime\.worker_count"):
            with_tables(Config(), {"runtime": {"zzz": 1}}, subject="options")

    def test_a_missing_file_is_named(self, tmp_path):
        with pytest.raises(ConfigError, match=r"absent\.toml: expected a readable TOML file"):
            read_tables(tmp_path / "absent.toml")

    def test_a_file_that_is_no_text_is_named(self, tmp_path):
        path = tmp_path / "bytes.toml"
        path.write_bytes(b"\xff\xfe\x00")
        with pytest.raises(ConfigError, match=r"bytes\.toml: expected a readable TOML file"):
            read_tables(path)

    def test_options_are_named_as_such(self):
        with pytest.raises(ConfigError, match=r"options: expected runtime\.seed >= 0, found -1"):
            load_config("default", None, {"runtime": {"seed": -1}})

    def test_an_unknown_preset_is_refused(self):
        with pytest.raises(ConfigError, match="preset: expected one of default, precise, paper"):
            load_config("quick")
