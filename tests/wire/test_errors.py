import pytest
from google.rpc import code_pb2, error_details_pb2, status_pb2
from hypothesis import given
from hypothesis import strategies as st

from roel_service import errors
from roel_service.errors import Cancelled, InputError, RoelError
from roel_service.reasons import REASONS
from roel_service.wire.errors import (
    CODES,
    KINDS,
    MAX_TEXT_LENGTH,
    error_from_status,
    retry_after_s,
    status_from_error,
)

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


def test_a_bad_input_is_told_as_the_standard_has_it_too():
    status = status_from_error(InputError("page_size", "a size", "-1", reason="PAGE_SIZE_INVALID"))
    bad = error_details_pb2.BadRequest()
    assert status.details[1].Unpack(bad)
    (violation,) = bad.field_violations
    assert (violation.field, violation.description) == ("page_size", "expected a size, found -1")


def test_an_error_of_no_particular_reason_has_that_of_its_class():
    assert errors.NoAnswerError("map", "lines", "none").reason == "NO_ANSWER"
    assert InputError("--host", "a host", "none").reason == "INPUT_INVALID"


def test_no_code_is_shadowed_by_a_base_class_before_it():
    kinds = [kind for kind, _ in CODES]
    for index, kind in enumerate(kinds):
        assert not any(issubclass(kind, earlier) for earlier in kinds[:index])


def test_cancelled_comes_back_as_cancelled():
    assert isinstance(error_from_status(status_from_error(Cancelled())), Cancelled)


def test_long_texts_are_cut_to_fit_a_header():
    status = status_from_error(InputError(*("\U0001f600" * 10_000,) * 3))
    # In base64, beside the message once more with three characters for a byte: below 16 KiB.
    assert status.ByteSize() * 4 / 3 + 3 * len(status.message.encode()) < 2**14
    assert error_from_status(status).found == "\U0001f600" * MAX_TEXT_LENGTH


@pytest.mark.parametrize(
    ("code", "kind", "reason"),
    [
        (code_pb2.INVALID_ARGUMENT, errors.InputError, "INPUT_INVALID"),
        (code_pb2.FAILED_PRECONDITION, errors.StateError, "WRONG_STATE"),
        (code_pb2.ABORTED, errors.ConflictError, "CONFLICT"),
        (code_pb2.DATA_LOSS, errors.CorruptionError, "BLOB_CORRUPT"),
        (code_pb2.UNAVAILABLE, errors.UnavailableError, "UNAVAILABLE"),
        (code_pb2.DEADLINE_EXCEEDED, errors.UnavailableError, "UNAVAILABLE"),
        (code_pb2.RESOURCE_EXHAUSTED, errors.LimitError, "LIMIT_EXCEEDED"),
        (code_pb2.UNIMPLEMENTED, errors.UnimplementedError, "METHOD_NOT_IMPLEMENTED"),
        (code_pb2.UNKNOWN, RoelError, "INTERNAL"),
    ],
)
def test_a_status_without_details_names_who_answered(code, kind, reason):
    status = status_pb2.Status(code=code, message="from gRPC itself")
    error = error_from_status(status, subject="host:1")
    assert (type(error), error.reason) == (kind, reason)
    assert error.subject == "host:1"
    assert "from gRPC itself" in error.found


@pytest.mark.parametrize("row", REASONS.values(), ids=lambda row: row.name)
def test_where_waiting_helps_the_status_says_how_long(row):
    status = status_from_error(row.kind("s", "e", "f", reason=row.name))
    assert retry_after_s(status) == error_from_status(status).retry_after_s == row.retry_after_s


def test_an_unknown_kind_of_error_is_still_an_error():
    status = status_from_error(InputError("s", "e", "f"))
    packed = status.details[0]
    packed.value = packed.value.replace(b"InputError", b"FutureErrr")
    restored = error_from_status(status)
    assert type(restored) is RoelError
    assert restored.args == ("s", "e", "f")
