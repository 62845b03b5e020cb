from pathlib import Path

import pytest


@pytest.fixture(autouse=True)
def sample_tasks_can_be_imported(monkeypatch):
    """Children find modules where this process would."""
    monkeypatch.syspath_prepend(Path(__file__).parent)
