import filecmp
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def regenerated(tmp_path_factory):
    root = tmp_path_factory.mktemp("generated")
    command = [sys.executable, ROOT / "proto" / "generate.py", "--root", root]
    subprocess.run(command, check=True)
    return root


def test_committed_messages_are_those_of_the_sources(regenerated):
    fresh, committed = regenerated / "roel_service" / "v1", ROOT / "roel_service" / "v1"
    names = sorted(path.name for path in fresh.glob("*.py"))
    assert names == sorted(path.name for path in committed.glob("*.py"))
    _, different, missing = filecmp.cmpfiles(fresh, committed, names, shallow=False)
    assert not different, "run `make proto`"
    assert not missing


def test_committed_configuration_messages_are_those_of_the_dataclasses(regenerated):
    name = Path("proto") / "roel_service" / "v1" / "config.proto"
    assert (regenerated / name).read_text() == (ROOT / name).read_text(), "run `make proto`"
