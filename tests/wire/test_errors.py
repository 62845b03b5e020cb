import re
from pathlib import Path

import pytest
from google.rpc import code_pb2, status_pb2
from hypothesis import given
from hypothesis import strategies as st

from roel_service import errors
from roel_service.errors import Cancelled, InputError, RoelError
from roel_service.wire.errors import (
    CODES,
    KINDS,
    MAX_TEXT_LENGTH,
    error_from_status,
    status_from_error,
)

ROOT = Path(__file__).parents[2]

TEXT = st.text(st.characters(exclude_categories=["Cs"]), max_size=MAX_TEXT_LENGTH)


@given(
    st.sampled_from(sorted(KINDS)), TEXT, TEXT, TEXT, st.from_regex(r"[A-Z_]{3,60}", fullmatch=True)
)
def test_every_error_comes_back_as_itself(name, subject, expected, found, reason):
    error = KINDS[name](subject, expected, found, reason=reason)
    restored = error_from_status(status_from_error(error))
    assert type(restored) is type(error)
    assert (restored.args, restored.reason) == (error.args, reason)


@pytest.mark.parametrize(
    ("kind", "code"),
    [
        (errors.EventsError, code_pb2.INVALID_ARGUMENT),
        (errors.ConfigError, code_pb2.INVALID_ARGUMENT),
        (errors.NoAnswerError, code_pb2.FAILED_PRECONDITION),
        (errors.NotFoundError, code_pb2.NOT_FOUND),
        (errors.StateError, code_pb2.FAILED_PRECONDITION),
        (errors.ConflictError, code_pb2.ABORTED),
        (errors.LimitError, code_pb2.RESOURCE_EXHAUSTED),
        (errors.UnavailableError, code_pb2.UNAVAILABLE),
        (errors.CorruptionError, code_pb2.DATA_LOSS),
        (errors.RoelError, code_pb2.INTERNAL),
    ],
)
def test_codes_are_those_of_the_design(kind, code):
    assert status_from_error(kind("s", "e", "f")).code == code


def test_no_code_is_shadowed_by_a_base_class_before_it():
    kinds = [kind for kind, _ in CODES]
    for index, kind in enumerate(kinds):
        assert not any(issubclass(kind, earlier) for earlier in kinds[:index])


def test_cancelled_comes_back_as_cancelled():
    assert isinstance(error_from_status(status_from_error(Cancelled())), Cancelled)


def test_long_texts_are_cut_to_fit_a_header():
    status = status_from_error(InputError(*("\U0001f600" * 10_000,) * 3))
    assert status.ByteSize() < 5000
    assert error_from_status(status).found == "\U0001f600" * MAX_TEXT_LENGTH


@pytest.mark.parametrize(
    ("code", "kind"),
    [
        (code_pb2.UNAVAILABLE, errors.UnavailableError),
        (code_pb2.DEADLINE_EXCEEDED, errors.UnavailableError),
        (code_pb2.RESOURCE_EXHAUSTED, errors.LimitError),
        (code_pb2.UNIMPLEMENTED, RoelError),
    ],
)
def test_a_status_without_details_names_who_answered(code, kind):
    status = status_pb2.Status(code=code, message="from gRPC itself")
    error = error_from_status(status, subject="host:1")
    assert type(error) is kind
    assert error.subject == "host:1"
    assert "from gRPC itself" in error.found


def test_an_unknown_kind_of_error_is_still_an_error():
    status = status_from_error(InputError("s", "e", "f"))
    packed = status.details[0]
    packed.value = packed.value.replace(b"InputError", b"FutureErrr")
    restored = error_from_status(status)
    assert type(restored) is RoelError
    assert restored.args == ("s", "e", "f")


def documented_reasons():
    """Reason, class and code of every row of docs/errors.md."""
    rows = re.findall(
        r"^\| `(\w+)` \| `(\w+)` \| (\w+) \|", (ROOT / "docs" / "errors.md").read_text(), re.M
    )
    return {reason: (kind, code) for reason, kind, code in rows}


def raised_reasons():
    """Every reason that the source names."""
    sources = [*(ROOT / "roel_service").rglob("*.py"), *(ROOT / "clients").rglob("*.py")]
    texts = (path.read_text() for path in sources)
    return {
        name for text in texts for name in re.findall(r'reason(?:: [^=]*)? ?= ?"([A-Z_]+)"', text)
    }


def test_the_documented_reasons_are_those_that_can_be_raised():
    assert set(documented_reasons()) == raised_reasons()


def test_documented_codes_and_classes_are_true():
    for kind, code in documented_reasons().values():
        status = status_from_error(KINDS[kind]("subject", "expected", "found"))
        assert code_pb2.Code.Name(status.code) == code
    defaults = {kind.default_reason: name for name, kind in KINDS.items()}
    for reason, name in defaults.items():
        assert documented_reasons()[reason][0] == name
