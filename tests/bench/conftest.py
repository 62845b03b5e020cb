from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def rooms(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder that keeps simulated rooms: simulating one takes seconds."""
    return tmp_path_factory.mktemp("rooms")
