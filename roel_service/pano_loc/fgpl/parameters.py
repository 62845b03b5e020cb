"""What tells the method as published from its released code, and how much is searched."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class FgplParameters:
    """Switches and counts.

    Attributes:
        cost_per_axis: the rotation's cost of a pair is the sum of |(R n)_k d_k| over the axes
            instead of |(R n) . d|; both agree only where lines follow the world's axes.
        points_by_class: a point channel holds the intersections that involve one direction instead
            of those of one pair of directions.
        closes_gaps: a pair without lines in the map lets later pairs move up, instead of staying
            empty.
        place_count: of the pool of translations, about.
        refined_count: poses of each map that are refined.
        map_count: maps at the most whose poses are refined.
    """

    cost_per_axis: bool = False
    points_by_class: bool = False
    closes_gaps: bool = False
    place_count: int = 1700
    refined_count: int = 1
    map_count: int = 5


PUBLISHED = FgplParameters()
RELEASED = FgplParameters(cost_per_axis=True, points_by_class=True, closes_gaps=True)
VARIANTS = {"fgpl": PUBLISHED, "fgpl-released": RELEASED}
