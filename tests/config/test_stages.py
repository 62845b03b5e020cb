import dataclasses
import math
import re
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

import roel_service
from roel_service.config import stages
from roel_service.config.presets import PRESETS, preset
from roel_service.config.stages import Config, DetectConfig, FramesConfig, Stage
from roel_service.errors import ConfigError

TABLES = {item.name: type(getattr(Config(), item.name)) for item in dataclasses.fields(Config)}
PARAMETERS = [
    (table, item.name) for table, stage in TABLES.items() for item in dataclasses.fields(stage)
]


def default(table, name):
    return getattr(getattr(Config(), table), name)


def with_value(table, name, value):
    return dataclasses.replace(getattr(Config(), table), **{name: value})


RULES = {
    (table, item.name): item.metadata.get("rule")
    for table, stage in TABLES.items()
    for item in dataclasses.fields(stage)
}
RULED = [key for key, rule in RULES.items() if rule is not None]


class TestRanges:
    def test_every_number_and_name_has_a_range(self):
        without = [key for key, rule in RULES.items() if rule is None]
        assert all(isinstance(default(*key), bool) for key in without)

    @pytest.mark.parametrize(("table", "name"), RULED)
    def test_a_value_out_of_range_is_refused_by_its_path(self, table, name):
        value = default(table, name)
        if isinstance(value, str):
            wrong = "non\nsense"
        elif isinstance(value, tuple):
            wrong = ("nonsense",) if name == "representations" else (-1,)
        else:
            wrong = -1
        with pytest.raises(ConfigError) as caught:
            with_value(table, name, wrong)
        assert caught.value.subject == f"{table}.{name}"
        assert caught.value.expected == RULES[table, name].expected
        assert caught.value.found == repr(wrong)
        assert caught.value.reason == "CONFIG_INVALID"

    @pytest.mark.parametrize(
        ("table", "name"), [key for key in RULED if isinstance(default(*key), float)]
    )
    @pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
    def test_numbers_are_finite(self, table, name, value):
        with pytest.raises(ConfigError, match=f"{table}.{name}"):
            with_value(table, name, value)

    @pytest.mark.parametrize(
        ("table", "name"), [key for key in RULED if isinstance(default(*key), tuple)]
    )
    @pytest.mark.parametrize("value", [math.nan, math.inf])
    def test_numbers_of_lists_are_finite(self, table, name, value):
        with pytest.raises(ConfigError, match=f"{table}.{name}"):
            with_value(table, name, (0.5, value))

    @pytest.mark.parametrize(
        ("table", "name", "edge", "beyond"),
        [
            ("plane_fit", "min_occupancy", 1.0, 1.0 + 1e-9),
            ("plane_fit", "min_occupancy", 0.0, -1e-9),
            ("plane_fit", "speed_count", 2, 1),
            ("detect", "blur_px", 0.0, -1e-9),
            ("frames", "slot_us", 1, 0),
            ("triangulate", "scored_observation_count", 2, 1),
            ("runtime", "worker_count", 0, -1),
            ("trim", "min_length_m", 1e-9, 0.0),
        ],
    )
    def test_edges_of_ranges_belong_to_them(self, table, name, edge, beyond):
        assert getattr(with_value(table, name, edge), name) == edge
        with pytest.raises(ConfigError):
            with_value(table, name, beyond)

    @pytest.mark.parametrize(
        ("name", "value"),
        [
            ("representations", ()),
            ("representations", ("binary", "colour")),
            ("window_events_per_pixel", ()),
            ("window_events_per_pixel", (0.1, 0.0)),
            ("window_event_counts", (100, -1)),
        ],
    )
    def test_lists_are_checked_item_by_item(self, name, value):
        with pytest.raises(ConfigError, match=f"detect.{name}"):
            with_value("detect", name, value)

    def test_only_event_counts_may_be_left_out(self):
        assert DetectConfig(window_event_counts=()).window_event_counts == ()

    def test_the_shortest_window_is_not_longer_than_the_longest(self):
        assert FramesConfig(min_half_window_us=25_000).min_half_window_us == 25_000
        with pytest.raises(ConfigError, match=r"frames.min_half_window_us: expected <= max_half"):
            FramesConfig(min_half_window_us=25_001)

    @given(st.sampled_from(RULED), st.integers(-3, 3))
    def test_an_integer_is_taken_as_it_is_or_refused(self, key, value):
        given_value = (value,) if isinstance(default(*key), tuple) else value
        refused = None
        try:
            stage = with_value(*key, given_value)
        except ConfigError as error:
            refused = error
        if refused is None:
            assert getattr(stage, key[1]) == given_value
            assert RULES[key].holds(given_value)
        else:
            # A longest window that is too short is told as a shortest one that is too long.
            window = key == ("frames", "max_half_window_us") and value > 0
            named = ("frames", "min_half_window_us") if window else key
            assert refused.subject == ".".join(named)


class TestConfig:
    def test_it_cannot_be_changed_in_place(self):
        with pytest.raises(dataclasses.FrozenInstanceError):
            Config().runtime.seed = 3
        with pytest.raises(dataclasses.FrozenInstanceError):
            Config().runtime = None

    def test_tables_carry_the_names_of_their_attributes(self):
        assert {name: stage.table for name, stage in TABLES.items()} == {n: n for n in TABLES}

    def test_every_table_is_part_of_it(self):
        defined = {
            item
            for item in vars(stages).values()
            if isinstance(item, type) and issubclass(item, Stage) and item is not Stage
        }
        assert defined == set(TABLES.values())

    def test_equal_values_are_equal_configurations(self):
        assert Config() == Config()
        assert dataclasses.replace(Config(), frames=FramesConfig(rate_hz=29.0)) != Config()

    @pytest.mark.parametrize(("table", "name"), PARAMETERS)
    def test_every_parameter_is_documented(self, table, name):
        assert re.search(rf"\b{name}\b", TABLES[table].__doc__)

    @pytest.mark.parametrize(("table", "name"), PARAMETERS)
    def test_every_parameter_is_read_somewhere(self, table, name):
        """A knob that nothing reads is dead."""
        package = Path(roel_service.__file__).parent
        sources = [
            path.read_text(encoding="utf-8")
            for folder in ("mapping", "register", "pano_loc", "tracking", "jobs", "service")
            for path in (package / folder).rglob("*.py")
        ]
        assert any(re.search(rf"\.{name}\b", source) for source in sources)


class TestPresets:
    def test_the_default_preset_holds_the_defaults(self):
        assert preset("default") == Config()

    def test_the_precise_preset_only_keeps_fewer_lines(self):
        precise, default = preset("precise"), Config()
        assert dataclasses.replace(precise, trim=default.trim) == default
        assert precise.trim.max_error_m < default.trim.max_error_m

    def test_the_paper_preset_holds_the_published_values(self):
        paper = preset("paper")
        assert paper.detect.representations == ("binary", "timestamp")
        assert len(paper.detect.window_events_per_pixel) == 2
        assert not paper.frames.compensate_rotation
        # Table of key parameters.
        assert paper.plane_fit.inlier_distance_px == 2
        assert paper.plane_fit.support_event_count == 100
        assert paper.plane_fit.time_scale_px_per_ms == 20
        assert paper.plane_fit.candidate_distance_px == 10
        assert paper.match_global.min_epipolar_score == 0.3
        assert paper.triangulate.max_grassmann_angle_deg == 1.4
        assert paper.triangulate.min_inlier_count == 10
        assert paper.refine.event_weight == 1e4
        assert paper.refine.event_count_per_line == 50
        # Implementation details.
        assert paper.plane_fit.method == "ransac"
        assert (paper.match_local.predict, paper.match_local.reach_frame_count) == (False, 1)
        assert paper.match_global.method == "sampled"
        assert (paper.match_global.frame_stride, paper.match_global.neighbor_count) == (5, 20)
        assert (paper.triangulate.gate, paper.triangulate.merge) == ("grassmann", True)
        assert (paper.refine.residual, paper.trim.method) == ("grassmann", "cluster")

    def test_presets_differ(self):
        assert len(set(map(repr, PRESETS.values()))) == len(PRESETS)

    def test_an_unknown_preset_names_the_known_ones(self):
        with pytest.raises(
            ConfigError, match="expected one of default, precise, paper, found fast"
        ):
            preset("fast")
