"""Where children keep what they may need again; the front names it without knowing what that is."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class CachePlace:
    """Where results of stages are kept, and how much of them."""

    folder: Path
    max_bytes: int
