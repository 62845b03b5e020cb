from __future__ import annotations

import os
from pathlib import Path

import pytest
from hypothesis import settings

# Some tests fork in a process in which others have used gRPC. Its fork handlers are for children that
# go on using it, which none does; where they cannot run they say so on stderr.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"
# As in the children of the service and of the command: what they and the library find is compared bit
# by bit, and sums over several threads have another order.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ[name] = "1"

# No limit on time: a busy machine is no failure. Few examples, drawn anew in every run.
settings.register_profile("project", deadline=None, max_examples=30)
settings.load_profile("project")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first: at the end one worker would wait for them while the other has no work."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


@pytest.fixture(scope="session")
def data_folder() -> Path:
    """Recordings that are not part of the repository; tests that need them skip without."""
    default = Path(__file__).resolve().parents[2] / "shared" / "data"
    folder = Path(os.environ.get("ROEL_DATA", default))
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}")
    return folder
