"""A manifest of requests, answered one after the other; entry points of batches."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from roel_service.errors import InputError, RoelError
from roel_service.jobs.asked import Questions, questions_of
from roel_service.jobs.batch_inputs import BatchParameters
from roel_service.jobs.desk import Desk
from roel_service.jobs.faults import logged_fault
from roel_service.jobs.questions import Question
from roel_service.jobs.task import Tell
from roel_service.progress import Progress
from roel_service.store.batches import AnsweredBatch
from roel_service.v1 import localization_pb2, registration_pb2
from roel_service.wire.delimited import delimited, messages
from roel_service.wire.errors import status_from_error

SUBJECT = "manifest"


@dataclass(frozen=True, kw_only=True)
class Kind:
    """What a batch is made of.

    Attributes:
        stage: what its progress is called.
        request, item: classes of messages.
        question: makes a question of a request.
    """

    stage: str
    request: Any
    item: Any
    question: Callable[[Questions, Any], Question]


_REGISTER = Kind(
    stage="register",
    request=registration_pb2.RegisterRequest,
    item=registration_pb2.BatchRegisterItem,
    question=Questions.registration,
)
_LOCALIZE = Kind(
    stage="localize",
    request=localization_pb2.LocalizeRequest,
    item=localization_pb2.BatchLocalizeItem,
    question=Questions.localization,
)


def run_batch_register(parameters: BatchParameters, tell: Tell) -> AnsweredBatch:
    """Entry point of BatchRegister."""
    return _run(_REGISTER, parameters, tell)


def run_batch_localize(parameters: BatchParameters, tell: Tell) -> AnsweredBatch:
    """Entry point of BatchLocalize."""
    return _run(_LOCALIZE, parameters, tell)


def _run(kind: Kind, parameters: BatchParameters, tell: Tell) -> AnsweredBatch:
    """Go on where the best attempt ended.

    Raises:
        InputError: MANIFEST_INVALID.
    """
    known = _known_items(kind, parameters)
    failed_count = sum(item.HasField("error") for item in known)
    desk = Desk()
    with (
        parameters.journal.open("wb") as journal,
        questions_of(
            parameters.folder, parameters.cache, parameters.inline_point_count
        ) as questions,
        parameters.manifest.open("rb") as manifest,
    ):
        journal.writelines(delimited(item) for item in known)
        for index, request in _requests(kind, manifest, parameters, len(known)):
            tell(_progress(kind, index, len(known), parameters.item_count))
            item = _answered(kind, index, request, questions, desk)
            failed_count += item.HasField("error")
            journal.write(delimited(item))
            # Out of this process: whoever kills it does not take the answer along.
            journal.flush()
        os.fsync(journal.fileno())
    return AnsweredBatch(
        journal=parameters.journal, item_count=parameters.item_count, failed_count=failed_count
    )


def _known_items(kind: Kind, parameters: BatchParameters) -> list[Any]:
    """What the best of the earlier attempts answered."""
    found = (_whole_items(kind, path) for path in parameters.earlier_journals)
    return max(found, key=len, default=[])


def _whole_items(kind: Kind, path: Path) -> list[Any]:
    """Items of a journal up to the one that was being written."""
    items: list[Any] = []
    with path.open("rb") as file:
        try:
            for item in messages(file, kind.item, subject=str(path), max_bytes=2**31):
                if item.index != len(items) or item.WhichOneof("outcome") is None:
                    break
                items.append(item)
        except InputError:
            return items
    return items


def _requests(
    kind: Kind, manifest: BinaryIO, parameters: BatchParameters, done_count: int
) -> Iterator[tuple[int, Any]]:
    """Those that have no answer yet, with their places."""
    all_requests = messages(
        manifest, kind.request, subject=SUBJECT, max_bytes=parameters.max_item_bytes
    )
    return itertools.islice(enumerate(all_requests), done_count, None)


def _answered(kind: Kind, index: int, request: Any, questions: Questions, desk: Desk) -> Any:
    """One item: the answer, or why there is none."""
    item = kind.item(index=index)
    try:
        item.response.CopyFrom(desk.answer(kind.question(questions, request)))
    except RoelError as error:
        item.error.CopyFrom(status_from_error(error))
    except Exception as error:  # the border of an item: the others have to be answered too
        item.error.CopyFrom(status_from_error(logged_fault(error, f"item {index} of a batch")))
    return item


def _progress(kind: Kind, done_count: int, cached_count: int, total_count: int) -> Progress:
    return Progress(
        stage=kind.stage,
        done_count=done_count,
        total_count=total_count,
        fraction=done_count / max(1, total_count),
        cached_count=cached_count,
    )
