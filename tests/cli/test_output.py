from __future__ import annotations

import io
import json
import logging
import math
import os
import sys
from pathlib import Path

import pytest

from roel_client.cli.output import (
    logging_to_stderr,
    print_result,
    progress_bar,
    say,
    to_json,
    write_crash_report,
)
from roel_service.progress import Progress, ignore


def test_json_is_one_line_without_nan() -> None:
    text = to_json({"a": math.nan, "b": [1.5, -math.inf], "c": {"d": "ü\n"}})
    assert "\n" not in text
    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": {"d": "ü\n"}}


def test_result_is_json_or_text(capsys: pytest.CaptureFixture[str]) -> None:
    print_result({"a": 1}, "one", as_json=True)
    print_result({"a": 1}, "one", as_json=False)
    assert capsys.readouterr().out == '{"a": 1}\none\n'


def test_failure_is_one_line_whatever_is_in_it(capsys: pytest.CaptureFixture[str]) -> None:
    say("roel: error: a\nb: expected c,\tfound d")
    assert capsys.readouterr().err == "roel: error: a b: expected c, found d\n"


def test_warnings_wait_for_success(capsys: pytest.CaptureFixture[str]) -> None:
    with logging_to_stderr("warning") as log:
        logging.getLogger("somewhere").warning("careful")
        assert capsys.readouterr().err == ""
        log.flush()
    assert capsys.readouterr().err == "roel: WARNING: careful\n"


def test_warnings_of_a_command_that_fails_are_dropped(capsys: pytest.CaptureFixture[str]) -> None:
    with logging_to_stderr("warning"):
        logging.getLogger("somewhere").warning("careful")
    assert capsys.readouterr().err == ""


def test_details_come_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    with logging_to_stderr("info"):
        logging.getLogger("somewhere").info("now")
        assert capsys.readouterr().err == "roel: INFO: now\n"


def test_no_bar_where_stderr_is_no_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    with progress_bar() as progress:
        assert progress is ignore
    assert capsys.readouterr().err == ""


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_bar_shows_stage_and_share_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with progress_bar() as progress:
        progress(Progress(stage="detect", done_count=1, total_count=2, fraction=0.0))
        progress(Progress(stage="refine", done_count=1, total_count=1, fraction=1.0))
    assert "refine" in terminal.getvalue()
    assert "100 %" in terminal.getvalue()


def test_crash_report_holds_command_and_traceback() -> None:
    name = write_crash_report(["map", "info", "a.rlm"], "Traceback ...")
    text = Path(name).read_text(encoding="utf-8")
    os.unlink(name)
    assert "['map', 'info', 'a.rlm']" in text
    assert "Traceback ..." in text
