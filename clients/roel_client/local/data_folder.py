"""The data folder of a server, and who may call it."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

US_PER_DAY = 24 * 3600 * 1_000_000


def create_token(
    data: Path, name: str, role: str, days: int | None, quota: Mapping[str, int | None]
) -> str:
    """Name a caller of the server on a folder; its token.

    Args:
        quota: fields of `store.quotas.Quota`.
    """
    from roel_service.store.principals import Role
    from roel_service.store.quotas import Quota
    from roel_service.store.records import now_us
    from roel_service.store.store import opened_principals

    expire_time_us = 0 if days is None else now_us() + days * US_PER_DAY
    with opened_principals(data) as principals:
        return principals.create(name, Role[role.upper()], expire_time_us, Quota(**quota))


def list_tokens(data: Path) -> list[dict[str, Any]]:
    """Who may call the server on a folder."""
    from roel_service.store.store import opened_principals

    with opened_principals(data) as principals:
        return [
            {
                "name": item.name,
                "role": item.role.label,
                "created": _iso_time(item.create_time_us),
                "expires": _iso_time(item.expire_time_us) if item.expire_time_us else None,
                "quota": dataclasses.asdict(item.quota),
            }
            for item in principals.list()
        ]


def revoke_token(data: Path, name: str) -> None:
    """Let a caller in no longer; raises `NotFoundError`."""
    from roel_service.store.store import opened_principals

    with opened_principals(data) as principals:
        principals.revoke(name)


def _iso_time(time_us: int) -> str:
    return datetime.fromtimestamp(time_us / 1e6, UTC).isoformat(timespec="seconds")


def check_data(folder: str) -> dict[str, Any]:
    """What a check of a data folder found; raises `NoAnswerError` DATA_UNSOUND for problems."""
    from roel_service.errors import NoAnswerError
    from roel_service.store.fsck import check_folder

    findings = asdict(check_folder(Path(folder)))
    problems = findings["problems"]
    if problems:
        found = f"{len(problems)} problems, first: {problems[0]}"
        reason = "DATA_UNSOUND"
        raise NoAnswerError(folder, "a sound folder", found, reason=reason, result=findings)
    return findings


def back_up_data(folder: str, target: Path) -> dict[str, Any]:
    """Copy a data folder to a new place; what the check of the copy found."""
    from roel_service.store.backup import back_up

    return asdict(back_up(Path(folder), target))


def collect_garbage(folder: str) -> dict[str, Any]:
    """Delete what nobody needs; how much that was. No server may have the folder."""
    from roel_service.errors import InputError
    from roel_service.store.store import Store

    if not (Path(folder) / "rows.sqlite").is_file():
        raise InputError(folder, "a data folder", "none")
    with Store(Path(folder)) as store:
        return asdict(store.collect_garbage())
