"""What an import may cost: the client and the front of the server stay light."""

from __future__ import annotations

import json
import pkgutil
import subprocess
import sys
from pathlib import Path

import roel_client
import roel_service

ALGORITHMS = {"torch", "open3d", "cv2", "numba"}


def modules_of(package_path: list[str], prefix: str) -> list[str]:
    return [found.name for found in pkgutil.walk_packages(package_path, prefix)]


def loaded_by(*names: str) -> set[str]:
    """Top-level modules in a fresh interpreter after importing these."""
    program = (
        f"import sys, json, importlib\n[importlib.import_module(n) for n in {list(names)!r}]\n"
        "print(json.dumps(sorted({name.partition('.')[0] for name in sys.modules})))"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    )
    return set(json.loads(done.stdout))


def test_importing_the_package_loads_no_other_library() -> None:
    loaded = loaded_by("roel_service")
    assert not loaded & {*ALGORITHMS, "numpy", "scipy", "grpc", "google", "matplotlib"}


def test_starting_the_command_line_loads_no_other_library() -> None:
    loaded = loaded_by("roel_client.cli.main")
    assert not loaded & {*ALGORITHMS, "numpy", "scipy", "grpc", "google", "matplotlib", "tqdm"}


def test_no_module_of_the_client_loads_an_algorithm() -> None:
    names = modules_of(list(roel_client.__path__), "roel_client.")
    assert "roel_client.local.maps" in names
    assert not loaded_by(*names) & ALGORITHMS


def test_front_of_the_server_loads_no_algorithm() -> None:
    names = modules_of([str(Path(roel_service.__path__[0], "service"))], "roel_service.service.")
    assert not loaded_by("roel_service.service", *names) & ALGORITHMS


def test_open3d_and_matplotlib_wait_until_they_are_needed() -> None:
    names = modules_of(list(roel_service.__path__), "roel_service.")
    assert not loaded_by(*names) & {"open3d", "matplotlib"}
