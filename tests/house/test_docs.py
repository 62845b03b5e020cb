"""Generated pages are what their sources say."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def fresh(tmp_path_factory):
    folder = tmp_path_factory.mktemp("docs")
    subprocess.run([sys.executable, ROOT / "docs/generate.py", "--root", folder], check=True)
    return folder


@pytest.mark.parametrize("page", ["errors.md", "api.md"])
def test_a_generated_page_is_current(fresh, page):
    assert (fresh / page).read_text() == (ROOT / "docs" / page).read_text()
