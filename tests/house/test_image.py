"""The Dockerfile's install and start steps, run in an empty folder without a container engine."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]

# The one step that changes the machine; `make` runs the same script, see test_repository.
MACHINE_STEP = "system_libraries"


@dataclass(frozen=True, kw_only=True)
class Stage:
    """Instructions of one build stage as (name, arguments), in their order."""

    instructions: tuple[tuple[str, str], ...]

    def arguments(self, name: str) -> list[str]:
        return [arguments for found, arguments in self.instructions if found == name]


@pytest.fixture(scope="module")
def stages() -> list[Stage]:
    joined = re.sub(r"\\\n\s*", "", (ROOT / "Dockerfile").read_text())
    lines = [line for line in joined.splitlines() if line and not line.startswith("#")]
    found: list[list[tuple[str, str]]] = []
    for line in lines:
        name, _, arguments = line.partition(" ")
        if name == "FROM":
            found.append([])
        found[-1].append((name, arguments.strip()))
    return [Stage(instructions=tuple(instructions)) for instructions in found]


def copied_sources(stage: Stage) -> list[str]:
    """What a stage copies from the repository."""
    lines = [line for line in stage.arguments("COPY") if not line.startswith("--from=")]
    return [source for line in lines for source in line.split()[:-1]]


def exec_form(arguments: str) -> list[str]:
    """Words of an instruction in JSON form, behind whatever flags stand before it."""
    return [str(word) for word in json.loads(arguments[arguments.index("[") :])]


def test_image_runs_without_root_and_keeps_its_state_in_one_volume(stages: list[Stage]) -> None:
    runtime = stages[-1]
    assert all(int(user) > 0 for user in runtime.arguments("USER"))
    assert runtime.instructions.index(("USER", "10001")) < len(runtime.instructions) - 1
    assert runtime.arguments("VOLUME") == ["/data"]
    assert "/data" in exec_form(runtime.arguments("CMD")[0])


def test_all_that_is_copied_exists_and_passes_dockerignore(stages: list[Stage]) -> None:
    sources = [source for stage in stages for source in copied_sources(stage)]
    allowed = (ROOT / ".dockerignore").read_text().splitlines()
    assert sources
    assert [source for source in sources if not (ROOT / source).exists()] == []
    assert [source for source in sources if f"!{source}" not in allowed] == []


@dataclass(frozen=True, kw_only=True)
class Box:
    """A folder that stands for the image's root."""

    root: Path
    environment: dict[str, str]

    def placed(self, text: str) -> str:
        """The text with the image's absolute paths moved into the box."""
        return re.sub(r"(?<![\w./])/(opt|data|var|src)\b", rf"{self.root}/\1", text)

    def run(self, command: str) -> None:
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", self.placed(command)],
            cwd=self.root / "src",
            env=self.environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, f"{command}\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}"


def empty_box(root: Path, runtime: Stage) -> Box:
    """A box without any package: the interpreter's own folder leads PATH."""
    for name in ("src", "opt", "data", "var/cache/roel"):
        (root / name).mkdir(parents=True)
    inherited = {key: os.environ[key] for key in ("HOME", "LANG") if key in os.environ}
    path = f"{Path(sys.base_prefix, 'bin')}{os.pathsep}{os.environ['PATH']}"
    bare = Box(root=root, environment={**inherited, "PATH": path})
    settings = dict(pair.split("=") for line in runtime.arguments("ENV") for pair in line.split())
    placed = {key: bare.placed(value).replace("$PATH", path) for key, value in settings.items()}
    return Box(root=root, environment={**bare.environment, **placed})


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_install_and_start_steps_work_in_an_empty_environment(
    stages: list[Stage], tmp_path: Path
) -> None:
    build, runtime = stages
    box = empty_box(tmp_path, runtime)
    for source in copied_sources(build):
        place = tmp_path / "src" / source
        if (ROOT / source).is_dir():
            shutil.copytree(ROOT / source, place, ignore=shutil.ignore_patterns("__pycache__"))
        else:
            shutil.copy(ROOT / source, place)
    steps = [step for stage in stages for step in stage.arguments("RUN")]
    assert [step for step in steps if step.startswith(MACHINE_STEP)] == [steps[1]]
    for step in steps:
        if not step.startswith(MACHINE_STEP):
            box.run(step)
    assert any((tmp_path / "var/cache/roel").rglob("*.nbi")), "no kernel was compiled in advance"
    check_that_it_serves(box, runtime)


def check_that_it_serves(box: Box, runtime: Stage) -> None:
    """The start command serves, its health check says so, and SIGTERM ends it with 0."""
    command = [box.placed(word) for word in exec_form(runtime.arguments("CMD")[0])]
    # A free port: the image's own may be taken on this machine.
    server = subprocess.Popen(
        [str(box.root / "opt/roel/bin" / command[0]), *command[1:], "--port", "0"],
        env=box.environment,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        assert server.stdout is not None
        port = json.loads(server.stdout.readline())["address"].rpartition(":")[2]
        health = exec_form(runtime.arguments("HEALTHCHECK")[0])
        box.run(" ".join(health).replace(":50051", f":{port}"))
        server.send_signal(signal.SIGTERM)
        assert server.wait(timeout=30) == 0
    finally:
        server.kill()
        server.wait()
        server.stdout.close()
