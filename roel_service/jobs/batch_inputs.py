"""Inputs of a batch in a child; named by the front, read in the child."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from roel_service.jobs.cache_place import CachePlace


@dataclass(frozen=True, kw_only=True)
class BatchParameters:
    """What to answer.

    Attributes:
        folder: the data folder, in which the requests' maps and blobs are looked up.
        manifest: requests.
        item_count: of them.
        max_item_bytes: of one request.
        journal: where the answers go; new.
        earlier_journals: what earlier attempts left.
        cache, inline_point_count: as of `Questions`.
    """

    folder: Path
    manifest: Path
    item_count: int
    max_item_bytes: int
    journal: Path
    earlier_journals: Sequence[Path]
    cache: CachePlace | None
    inline_point_count: int
