"""The table of reasons is complete, true, and every row of it is raised by a test."""

import ast
import re
from pathlib import Path

import pytest

from roel_service.reasons import REASONS
from roel_service.wire.errors import KINDS

ROOT = Path(__file__).resolve().parents[2]
ASSIGNED = re.compile(r'reason(?:: [^=]*)? ?= ?"([A-Z0-9_]+)"')


def texts(*folders):
    """Every Python source below the folders, but this one."""
    paths = (path for folder in folders for path in (ROOT / folder).rglob("*.py"))
    return [path.read_text() for path in paths if path != Path(__file__)]


def errors_made(text):
    """(class, reason) of every error that is constructed with a literal reason."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Call):
            name = getattr(node.func, "attr", getattr(node.func, "id", ""))
            for keyword in node.keywords:
                if keyword.arg == "reason" and isinstance(keyword.value, ast.Constant):
                    yield name, keyword.value.value


def test_the_table_holds_the_reasons_that_the_code_raises_and_no_others():
    raised = {name for text in texts("roel_service", "clients") for name in ASSIGNED.findall(text)}
    assert set(REASONS) == raised


def test_a_reason_is_raised_with_the_class_of_its_row():
    made = {pair for text in texts("roel_service", "clients") for pair in errors_made(text)}
    assert made
    assert {pair for pair in made if REASONS[pair[1]].kind.__name__ != pair[0]} == set()


def test_default_reasons_belong_to_their_classes():
    for kind in KINDS.values():
        if "default_reason" in vars(kind):
            assert REASONS[kind.default_reason].kind is kind


@pytest.fixture(scope="module")
def tested():
    """Every text in quotes that a test holds."""
    return {name for text in texts("tests") for name in re.findall(r'"([A-Z0-9_]+)"', text)}


@pytest.mark.parametrize("reason", REASONS)
def test_a_test_raises_the_reason(tested, reason):
    """A test that raises an error says its reason: `caught.value.reason == "..."`."""
    assert reason in tested
