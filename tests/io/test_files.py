import os
import stat

import pytest

from roel_service.errors import InputError
from roel_service.io.files import open_input, read_input, whole_file


def siblings(path):
    return sorted(entry.name for entry in path.iterdir())


def test_finished_file_replaces_the_old_one(tmp_path):
    target = tmp_path / "map.rlm"
    target.write_text("old")
    with whole_file(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".rlm"
        temporary.write_text("new")
        assert target.read_text() == "old"
    assert target.read_text() == "new"
    assert siblings(tmp_path) == ["map.rlm"]


@pytest.mark.parametrize("failure", [ValueError, KeyboardInterrupt, SystemExit])
def test_failure_leaves_the_old_file_and_nothing_else(tmp_path, failure):
    target = tmp_path / "out.txt"
    target.write_text("old")

    def write_half():
        with whole_file(target) as temporary:
            temporary.write_text("half")
            raise failure

    with pytest.raises(failure):
        write_half()
    assert target.read_text() == "old"
    assert siblings(tmp_path) == ["out.txt"]


def test_failure_creates_no_file(tmp_path):
    with pytest.raises(ValueError, match="stop"), whole_file(tmp_path / "out.txt"):
        raise ValueError("stop")
    assert siblings(tmp_path) == []


def test_symbolic_link_is_written_through(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    link = tmp_path / "link.txt"
    link.symlink_to("real.txt")
    with whole_file(link) as temporary:
        temporary.write_text("new")
    assert link.is_symlink()
    assert (tmp_path / "real.txt").read_text() == "new"


def test_new_file_has_the_permissions_of_the_umask(tmp_path):
    umask = os.umask(0o027)
    try:
        with whole_file(tmp_path / "out.txt") as temporary:
            temporary.write_text("x")
    finally:
        os.umask(umask)
    assert stat.S_IMODE((tmp_path / "out.txt").stat().st_mode) == 0o640


@pytest.mark.parametrize("name", ["", "missing/out.txt", "nul\0byte", "x" * 300])
def test_place_that_cannot_be_written_is_an_input_error(tmp_path, name):
    with pytest.raises(InputError, match="expected a file to write"), whole_file(tmp_path / name):
        pass
    assert siblings(tmp_path) == []


def test_device_is_not_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="a folder or device"), whole_file(pipe):
        pass
    assert stat.S_ISFIFO(pipe.stat().st_mode)


def test_unreadable_inputs_are_told_apart(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for path, found in (
        (tmp_path / "none", "no such file or directory"),
        (tmp_path, "a folder"),
        (pipe, "a pipe or device"),
        (tmp_path / "a\0b", "null"),
    ):
        with pytest.raises(InputError, match="expected a readable file") as caught:
            open_input(path)
        assert found in str(caught.value)
        assert "\n" not in str(caught.value)


def test_small_input_is_bounded(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"12345")
    assert read_input(path, 5) == b"12345"
    with pytest.raises(InputError, match="at most 4 bytes"):
        read_input(path, 4)
