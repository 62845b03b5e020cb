import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from roel_service.config.presets import PRESETS, preset
from roel_service.config.stages import Config
from roel_service.errors import ConfigError
from roel_service.v1 import config_pb2
from roel_service.wire.configs import config_from_proto, config_to_proto


@pytest.mark.parametrize("name", PRESETS)
def test_whole_presets_round_trip_over_any_other_preset(name):
    message = config_to_proto(preset(name))
    assert config_from_proto(message, "default") == preset(name)
    assert config_from_proto(message, "paper") == preset(name)


def test_field_names_are_those_of_the_dataclasses():
    tables = config_pb2.MappingConfig.DESCRIPTOR.fields
    assert [item.name for item in tables] == [item.name for item in dataclasses.fields(Config)]
    for table in tables:
        stage = getattr(Config(), table.name)
        names = [item.name for item in dataclasses.fields(stage)]
        assert [item.name for item in table.message_type.fields] == names


@given(st.floats(0.1, 1e3), st.integers(1, 10**9), st.booleans())
def test_present_fields_override_and_absent_ones_keep_the_preset(rate_hz, slot_us, compensate):
    message = config_pb2.MappingConfig()
    message.frames.rate_hz = rate_hz
    message.frames.slot_us = slot_us
    message.frames.compensate_rotation = compensate
    config = config_from_proto(message, "paper")
    assert config.frames.rate_hz == rate_hz
    assert config.frames.slot_us == slot_us
    assert config.frames.compensate_rotation == compensate
    assert config.plane_fit == preset("paper").plane_fit


def test_zero_and_the_empty_list_count_as_present():
    message = config_pb2.MappingConfig()
    message.detect.window_event_counts.SetInParent()
    message.detect.blur_px = 0.0
    config = config_from_proto(message, "paper")
    assert config.detect.window_event_counts == ()
    assert config.detect.blur_px == 0.0


def test_a_value_out_of_range_names_its_field():
    message = config_pb2.MappingConfig()
    message.plane_fit.candidate_distance_px = -1.0
    with pytest.raises(ConfigError, match=r"plane_fit\.candidate_distance_px > 0, found -1"):
        config_from_proto(message)


def test_an_unknown_preset_is_refused():
    with pytest.raises(ConfigError, match="preset: expected one of default, precise, paper"):
        config_from_proto(config_pb2.MappingConfig(), "fast")
