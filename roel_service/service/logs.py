"""Log records as one line each, for machines or for people."""

from __future__ import annotations

import json
import logging
from datetime import UTC, datetime
from typing import Any


class JsonFormatter(logging.Formatter):
    """One JSON object a line: time, level, logger, message, the record's fields, the traceback."""

    def format(self, record: logging.LogRecord) -> str:
        """The line."""
        line: dict[str, Any] = {
            "time": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            **fields_of(record),
        }
        if record.exc_info:
            line["traceback"] = self.formatException(record.exc_info)
        return json.dumps(line, ensure_ascii=False, default=str)


class TextFormatter(logging.Formatter):
    """Time, level, message, then the record's fields as `key=value`."""

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        """The line without a traceback."""
        fields = (f"{key}={value}" for key, value in fields_of(record).items())
        return " ".join([super().formatMessage(record), *fields])


FORMATTERS = {"json": JsonFormatter, "text": TextFormatter}


def fields_of(record: logging.LogRecord) -> dict[str, Any]:
    """What a record says beside its message: `logger.info(..., extra={"fields": {...}})`."""
    fields = getattr(record, "fields", {})
    return fields if isinstance(fields, dict) else {}
