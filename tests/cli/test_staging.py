from __future__ import annotations

import os
from pathlib import Path

import pytest

from roel_client.cli.staging import NamedFiles, publish, staging
from roel_service.errors import InputError


def named(
    inputs: dict[str, Path] | None = None,
    outputs: dict[str, Path] | None = None,
    folders: dict[str, Path] | None = None,
) -> NamedFiles:
    def text(paths: dict[str, Path] | None) -> dict[str, str]:
        return {option: str(path) for option, path in (paths or {}).items()}

    return NamedFiles(inputs=text(inputs), outputs=text(outputs), folders=text(folders))


def test_published_output_replaces_the_old_one_and_leaves_nothing_else(tmp_path: Path) -> None:
    out = tmp_path / "map.rlm"
    out.write_text("old")
    files = named(outputs={"out": out})
    with staging(files) as staged:
        staged["out"].write_text("new")
        assert out.read_text() == "old"
        publish(files, staged)
    assert out.read_text() == "new"
    assert os.listdir(tmp_path) == ["map.rlm"]


def test_output_that_is_not_published_does_not_appear(tmp_path: Path) -> None:
    def fail() -> None:
        with staging(named(outputs={"out": tmp_path / "map.rlm"})) as staged:
            staged["out"].write_text("half")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert os.listdir(tmp_path) == []


def test_staged_output_keeps_its_name(tmp_path: Path) -> None:
    with staging(named(outputs={"out": tmp_path / "map.ply"})) as staged:
        assert staged["out"].name == "map.ply"


def test_folder_is_published_over_an_empty_one(tmp_path: Path) -> None:
    (tmp_path / "room").mkdir()
    files = named(folders={"out": tmp_path / "room"})
    files.check()
    with staging(files) as staged:
        staged["out"].mkdir()
        (staged["out"] / "poses.txt").touch()
        publish(files, staged)
    assert os.listdir(tmp_path) == ["room"]
    assert os.listdir(tmp_path / "room") == ["poses.txt"]


def test_symbolic_link_stays_and_its_target_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "target").mkdir()
    link = tmp_path / "map.rlm"
    link.symlink_to(tmp_path / "target" / "real.rlm")
    files = named(outputs={"out": link})
    with staging(files) as staged:
        staged["out"].write_text("new")
        publish(files, staged)
    assert link.is_symlink()
    assert (tmp_path / "target" / "real.rlm").read_text() == "new"


def test_scratch_folder_goes_with_the_command() -> None:
    with staging(NamedFiles(inputs={}, outputs={}, folders={}, scratch=True)) as staged:
        assert staged["scratch"].is_dir()
    assert not staged["scratch"].exists()


def refusal(files: NamedFiles) -> str:
    with pytest.raises(InputError) as caught:
        files.check()
    return str(caught.value)


def test_missing_input_is_named_as_given(tmp_path: Path) -> None:
    path = tmp_path / "events.h5"
    assert (
        refusal(named({"events": path})) == f"{path}: expected a file, found nothing of that name"
    )


def test_folder_is_no_input(tmp_path: Path) -> None:
    assert refusal(named({"events": tmp_path})).endswith("expected a file, found a folder")


def test_output_in_a_missing_folder_is_refused(tmp_path: Path) -> None:
    assert "existing folder" in refusal(named(outputs={"out": tmp_path / "no" / "map.rlm"}))


def test_output_that_is_a_folder_is_refused(tmp_path: Path) -> None:
    assert "found a folder" in refusal(named(outputs={"out": tmp_path}))


def test_device_is_never_replaced() -> None:
    assert "found a device" in refusal(named(outputs={"out": Path("/dev/null")}))


def test_output_over_an_input_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    files = named({"events": tmp_path / "a"}, {"out": tmp_path / "." / "a"})
    assert "named twice" in refusal(files)


def test_two_outputs_of_one_name_are_refused(tmp_path: Path) -> None:
    files = named(outputs={"out": tmp_path / "a", "report": tmp_path / "a"})
    assert "named twice" in refusal(files)


def test_folder_with_files_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a").touch()
    assert "a folder with files in it" in refusal(named(folders={"out": tmp_path}))
