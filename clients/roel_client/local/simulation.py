"""Synthetic recordings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from roel_service.progress import ProgressCallback


def simulate(folder: Path, seed: int, progress: ProgressCallback, **given: Any) -> int:
    """Write a synthetic recording with its truth; number of its events.

    Args:
        folder: must not exist, or be empty.
        given: fields of `SimulationConfig` that differ from its defaults.
    """
    from roel_service.simulate.dataset import SimulationConfig, simulate_dataset

    return simulate_dataset(folder, SimulationConfig(**given), seed, progress)
