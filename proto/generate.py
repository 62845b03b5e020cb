"""Writes everything that follows from the sources of the protocol.

    python proto/generate.py [--root DIR]

1. `config.proto` from the configuration's dataclasses, and `config_numbers.json` beside this file,
   which keeps the numbers of its fields for ever;
2. `build/proto`, the third-party sources that protoc and buf need beside ours;
3. `roel_service/v1`, the messages and stubs, which are committed.
"""

from __future__ import annotations

import argparse
import json
import shutil
import sys
from importlib.resources import files
from pathlib import Path

from config_proto import config_proto, grown_numbers
from grpc_tools import protoc

HERE = Path(__file__).resolve().parent
PACKAGE = Path("roel_service/v1")
# googleapis-common-protos ships this file under a name other than the one it registers.
RENAMED = {"google/longrunning/operations_proto.proto": "google/longrunning/operations.proto"}
THIRD_PARTY = (
    "google/api/annotations.proto",
    "google/api/client.proto",
    "google/api/field_behavior.proto",
    "google/api/http.proto",
    "google/api/launch_stage.proto",
    "google/longrunning/operations_proto.proto",
    "google/rpc/status.proto",
)
INIT = '"""Generated messages and stubs of `roel_service.v1`; made by proto/generate.py."""\n'


def main() -> int:
    """Generate below the root; the exit code of protoc."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=HERE.parent, help="where to write")
    root = parser.parse_args().root
    sources = write_sources(root)
    third_party = write_third_party(root)
    return compile_stubs(root, sources, third_party)


def write_sources(root: Path) -> Path:
    """`proto/` of the root with a fresh config.proto; elsewhere than here it is copied first."""
    sources = root / "proto"
    if sources != HERE:
        shutil.copytree(HERE, sources, ignore=shutil.ignore_patterns("__pycache__"))
    table = sources / "config_numbers.json"
    numbers = grown_numbers(json.loads(table.read_text(encoding="utf-8")))
    table.write_text(json.dumps(numbers, indent=1) + "\n", encoding="utf-8")
    (sources / PACKAGE / "config.proto").write_text(config_proto(numbers), encoding="utf-8")
    return sources


def write_third_party(root: Path) -> Path:
    """The third-party sources under the names that they are imported by."""
    folder = root / "build" / "proto"
    packages = files("google")
    for name in THIRD_PARTY:
        target = folder / RENAMED.get(name, name)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(packages.joinpath(name.removeprefix("google/")).read_bytes())
    return folder


def compile_stubs(root: Path, sources: Path, third_party: Path) -> int:
    """Messages and stubs of every source, in a fresh folder."""
    output = root / PACKAGE
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    (output / "__init__.py").write_text(INIT, encoding="utf-8")
    well_known = files("grpc_tools").joinpath("_proto")
    arguments = [f"-I{sources}", f"-I{third_party}", f"-I{well_known}"]
    arguments += [f"--python_out={root}", f"--grpc_python_out={root}"]
    names = sorted(str(path) for path in (sources / PACKAGE).glob("*.proto"))
    return int(protoc.main(["protoc", *arguments, *names]))


if __name__ == "__main__":
    sys.exit(main())
