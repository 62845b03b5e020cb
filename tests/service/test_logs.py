import json
import logging
import sys

from roel_service.service.logs import JsonFormatter, TextFormatter


def record(fields=None, error=None):
    info = (type(error), error, error.__traceback__) if error else None
    made = logging.LogRecord("roel", logging.INFO, "file", 1, "call %s", ("x",), info)
    if fields is not None:
        made.fields = fields
    return made


def test_a_json_line_holds_the_fields_of_the_record():
    line = json.loads(JsonFormatter().format(record({"method": "/a", "ms": 1.5})))
    assert line.pop("time").endswith("+00:00")
    assert line == {
        "level": "info", "logger": "roel", "message": "call x", "method": "/a", "ms": 1.5
    }  # fmt: skip


def test_a_traceback_stays_within_the_line():
    try:
        raise ValueError("bad\nnews")
    except ValueError as error:
        text = JsonFormatter().format(record(error=error))
    assert "\n" not in text
    assert "ValueError: bad\nnews" in json.loads(text)["traceback"]
    assert sys.exc_info() == (None, None, None)


def test_a_line_for_people_ends_with_the_fields():
    text = TextFormatter().format(record({"method": "/a", "code": "OK"}))
    assert text.endswith(" INFO call x method=/a code=OK")
