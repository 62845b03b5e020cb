"""Exit codes and what stands on stderr, with the real child process but without a new interpreter."""

from __future__ import annotations

import argparse
import errno
import logging
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import pytest

from roel_client.cli import configuration
from roel_client.cli.main import main
from roel_client.cli.staging import Staged
from roel_service.errors import Cancelled, CorruptionError, NoAnswerError, UnavailableError

Outcome = tuple[int, str, str]


@pytest.fixture
def run_with(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> Callable[..., Outcome]:
    """Run `roel config show` with other work behind it; exit code, stdout, stderr."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.delenv("ROEL_LOG_LEVEL", raising=False)

    def run(work: Callable[[], None], *options: str) -> Outcome:
        def stand_in(_: argparse.Namespace, staged: Staged) -> None:
            work()

        monkeypatch.setattr(configuration, "show_config", stand_in)
        code = main(["config", "show", *options])
        captured = capfd.readouterr()
        return code, captured.out, captured.err

    return run


def raising(error: BaseException) -> Callable[[], None]:
    def work() -> None:
        raise error

    return work


def test_work_that_ends_is_code_0(run_with: Callable[..., Outcome]) -> None:
    assert run_with(lambda: None) == (0, "", "")


@pytest.mark.parametrize(("wanted", "had"), [(None, "1"), ("4", "4")])
def test_linear_algebra_has_one_thread_unless_the_user_wants_more(
    run_with: Callable[..., Outcome],
    monkeypatch: pytest.MonkeyPatch,
    wanted: str | None,
    had: str,
) -> None:
    monkeypatch.delenv("OPENBLAS_NUM_THREADS")
    if wanted:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", wanted)
    _, out, _ = run_with(lambda: sys.stdout.write(os.environ["OPENBLAS_NUM_THREADS"]))
    assert out.split() == [had]


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (
            CorruptionError("blob", "digest a", "digest b"),
            2,
            "roel: error: blob: expected digest a, found digest b",
        ),
        (
            UnavailableError("host:1", "a server", "nobody"),
            2,
            "roel: error: host:1: expected a server, found nobody",
        ),
        (
            NoAnswerError("map", "3 lines or more", "none"),
            3,
            "roel: no answer: map: expected 3 lines or more, found none",
        ),
        (
            OSError(errno.ENOSPC, "No space left on device", "m.rlm"),
            2,
            "roel: error: m.rlm: expected a place to write to, found No space left on device",
        ),
    ],
)
def test_what_the_work_raises_becomes_a_code_and_one_line(
    run_with: Callable[..., Outcome], error: Exception, code: int, line: str
) -> None:
    assert run_with(raising(error)) == (code, "", line + "\n")


def test_warning_before_a_failure_is_not_a_second_line(run_with: Callable[..., Outcome]) -> None:
    def work() -> None:
        logging.getLogger("io").warning("a share of the events was left out")
        raise NoAnswerError("map", "3 lines or more", "none")

    _, _, stderr = run_with(work)
    assert stderr.count("\n") == 1


def test_warning_of_work_that_ends_is_shown(run_with: Callable[..., Outcome]) -> None:
    outcome = run_with(lambda: logging.getLogger("io").warning("careful"))
    assert outcome == (0, "", "roel: WARNING: careful\n")


def test_bug_is_code_1_with_a_crash_report_and_no_traceback(
    run_with: Callable[..., Outcome], tmp_path: Path
) -> None:
    code, stdout, stderr = run_with(raising(ZeroDivisionError("deep inside")))
    assert (code, stdout) == (1, "")
    match = re.fullmatch(r"roel: internal error: crash report in (\S+)\n", stderr)
    assert match is not None
    assert Path(match[1]).parent == tmp_path
    assert "ZeroDivisionError: deep inside" in Path(match[1]).read_text()


def test_traceback_shows_at_log_level_debug(run_with: Callable[..., Outcome]) -> None:
    _, _, stderr = run_with(raising(ZeroDivisionError("deep inside")), "--log-level", "debug")
    assert "Traceback" in stderr
    assert "crash report in" in stderr.splitlines()[-1]


def test_worker_that_the_system_kills_is_code_1(run_with: Callable[..., Outcome]) -> None:
    code, _, stderr = run_with(lambda: os.kill(os.getpid(), signal.SIGKILL))
    assert code == 1
    assert stderr.count("\n") == 1
    report = Path(stderr.split()[-1])
    assert "SIGKILL" in report.read_text()


def test_closed_stdout_is_told_as_the_shell_does(run_with: Callable[..., Outcome]) -> None:
    assert run_with(raising(BrokenPipeError())) == (128 + signal.SIGPIPE, "", "")


def test_cancelled_work_ends_like_an_interrupt(run_with: Callable[..., Outcome]) -> None:
    assert run_with(raising(Cancelled())) == (130, "", "")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_the_command_without_a_word(
    run_with: Callable[..., Outcome], number: int
) -> None:
    def work() -> None:
        os.kill(os.getppid(), number)
        signal.pause()

    assert run_with(work) == (128 + number, "", "")


def test_unknown_log_level_of_the_environment_is_named(
    run_with: Callable[..., Outcome], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ROEL_LOG_LEVEL", "loud")
    code, _, stderr = run_with(lambda: None)
    assert code == 2
    assert stderr == (
        "roel: error: ROEL_LOG_LEVEL: expected one of debug, info, warning, error, found 'loud'\n"
    )
