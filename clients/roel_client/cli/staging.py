"""Output files that appear whole or not at all."""

from __future__ import annotations

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from roel_service.errors import InputError

# Option -> where the command writes it; moved to its own place when the command is done.
Staged = Mapping[str, Path]


@dataclass(frozen=True, kw_only=True)
class NamedFiles:
    """The files and folders of one command line, by option, as they were given."""

    inputs: Mapping[str, str]
    outputs: Mapping[str, str]
    folders: Mapping[str, str]
    scratch: bool = False

    def check(self) -> None:
        """Raise `InputError` for the first one that cannot be read or written."""
        for name in self.inputs.values():
            _check_input(name)
        taken = {os.path.realpath(name): name for name in self.inputs.values()}
        for name in self.outputs.values():
            _check_output(name)
        for name in self.folders.values():
            _check_folder(name)
        for name in [*self.outputs.values(), *self.folders.values()]:
            place = os.path.realpath(name)
            if place in taken:
                raise InputError(name, "a place of its own", f"{taken[place]}, named twice")
            taken[place] = name


def _check_input(name: str) -> None:
    path = Path(name)
    if path.is_dir():
        raise InputError(name, "a file", "a folder")
    if not path.exists():
        raise InputError(name, "a file", "nothing of that name")
    if not os.access(path, os.R_OK):
        raise InputError(name, "a file that can be read", "no permission")


def _check_output(name: str) -> None:
    path = Path(name)
    if path.is_dir():
        raise InputError(name, "a file name", "a folder")
    if path.exists() and not path.is_file():
        # Renaming a finished file onto a device would replace the device.
        raise InputError(name, "a regular file", "a device or pipe")
    _check_parent(name)


def _check_folder(name: str) -> None:
    path = Path(name)
    if path.exists() and not path.is_dir():
        raise InputError(name, "a new or empty folder", "a file")
    if path.is_dir() and any(path.iterdir()):
        raise InputError(name, "a new or empty folder", "a folder with files in it")
    _check_parent(name)


def _check_parent(name: str) -> None:
    parent = Path(os.path.realpath(name)).parent
    if not parent.is_dir():
        raise InputError(name, "a name in an existing folder", f"no folder {parent}")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise InputError(name, "a folder that can be written", f"no permission in {parent}")


@contextmanager
def staging(files: NamedFiles) -> Iterator[Staged]:
    """Where to write each output for now: a hidden folder beside its place, gone at the end.

    The staged file has its final name, so that formats told by suffix work. `scratch`, if asked
    for, is a temporary folder.
    """
    with ExitStack() as stack:
        staged = {}
        if files.scratch:
            staged["scratch"] = _hidden_folder(stack, Path(tempfile.gettempdir()))
        for option, name in [*files.outputs.items(), *files.folders.items()]:
            place = Path(os.path.realpath(name))
            staged[option] = _hidden_folder(stack, place.parent) / place.name
        yield staged


def _hidden_folder(stack: ExitStack, parent: Path) -> Path:
    """A new folder for this user alone, removed when the stack unwinds."""
    folder = parent / f".roel-{secrets.token_hex(8)}"
    # Before it exists: a signal may raise between any two lines.
    stack.callback(shutil.rmtree, folder, ignore_errors=True)
    folder.mkdir(mode=0o700)
    return folder


def publish(files: NamedFiles, staged: Staged) -> None:
    """Move every finished output to its place."""
    for option, name in [*files.outputs.items(), *files.folders.items()]:
        os.replace(staged[option], os.path.realpath(name))
