"""The small version of `python -m roel_crash`."""

import re
from pathlib import Path

import pytest

from roel_crash.run import crash
from roel_service.failpoints import FAILPOINTS, failpoint

ROOT = Path(__file__).resolve().parents[2]


def test_killed_servers_and_children_break_no_promise(tmp_path):
    with (tmp_path / "log").open("ab") as log:
        outcome = crash(tmp_path / "data", kill_count=3, seed=0, log=log, checker_count=1)
    assert outcome.kills.total() == 3
    assert outcome.broken == []


def test_every_named_step_is_met_somewhere():
    sources = "".join(path.read_text() for path in (ROOT / "roel_service").rglob("*.py"))
    assert set(re.findall(r'failpoint\("([a-z.]+)"\)', sources)) == set(FAILPOINTS)


@pytest.mark.parametrize("value", ["", "blob.linked:exit@0", "other.step:exit", "blob.linked:wait"])
def test_a_step_without_its_name_in_the_environment_is_passed(monkeypatch, value):
    monkeypatch.setenv("ROEL_FAILPOINT", value)
    failpoint("blob.linked")
