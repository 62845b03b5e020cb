"""Numbers of the fields of config.proto never change their meaning."""

import importlib.util
import json
from pathlib import Path

import pytest

PROTO = Path(__file__).resolve().parents[2] / "proto"


@pytest.fixture(scope="module")
def generator():
    spec = importlib.util.spec_from_file_location("config_proto", PROTO / "config_proto.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def numbers():
    return json.loads((PROTO / "config_numbers.json").read_text())


def test_a_known_field_keeps_its_number(generator, numbers):
    assert generator.grown_numbers(numbers) == numbers


def test_a_new_field_gets_the_next_number_wherever_it_stands(generator, numbers):
    known = {**numbers, "TrimConfig": dict(numbers["TrimConfig"])}
    first = next(iter(known["TrimConfig"]))
    del known["TrimConfig"][first]
    grown = generator.grown_numbers(known)["TrimConfig"]
    assert grown[first] == max(known["TrimConfig"].values()) + 1
    assert {name: grown[name] for name in known["TrimConfig"]} == known["TrimConfig"]


def test_a_field_that_is_gone_is_reserved(generator, numbers):
    numbers["DetectConfig"]["old_gap_m"] = 99
    text = generator.config_proto(generator.grown_numbers(numbers))
    assert '  reserved 99;\n  reserved "old_gap_m";\n' in text
    assert "old_gap_m =" not in text
