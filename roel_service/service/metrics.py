"""Counters, gauges and histograms in the text format of Prometheus.

The format is a page long and three kinds are needed, so they are here instead of in a dependency.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

# Values of a metric's labels, in the order of their names.
Labels = tuple[str, ...]

# Upper bounds in seconds: from a lookup to a long upload.
SECONDS_BOUNDS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1, 2.5, 10, 60, 600)


@dataclass(kw_only=True, eq=False)
class Counter:
    """A number that only grows, for each combination of labels."""

    name: str
    help: str
    label_names: tuple[str, ...] = ()
    _values: dict[Labels, float] = field(default_factory=dict)

    def add(self, *labels: str, amount: float = 1.0) -> None:
        """Count."""
        self._values[labels] = self._values.get(labels, 0.0) + amount

    def lines(self) -> Iterator[str]:
        """As Prometheus reads it."""
        yield from _heading(self.name, self.help, "counter")
        for labels, value in sorted(self._values.items()):
            yield _line(self.name, zip(self.label_names, labels, strict=True), value)


@dataclass(kw_only=True, eq=False)
class Gauge:
    """Numbers that are looked up when somebody asks for them."""

    name: str
    help: str
    read: Callable[[], Mapping[Labels, float]]
    label_names: tuple[str, ...] = ()
    kind: str = "gauge"

    def lines(self) -> Iterator[str]:
        """As Prometheus reads it."""
        yield from _heading(self.name, self.help, self.kind)
        for labels, value in sorted(self.read().items()):
            yield _line(self.name, zip(self.label_names, labels, strict=True), value)


@dataclass(kw_only=True, eq=False)
class Histogram:
    """How values are distributed, for each combination of labels."""

    name: str
    help: str
    label_names: tuple[str, ...] = ()
    bounds: tuple[float, ...] = SECONDS_BOUNDS
    _counts: dict[Labels, list[int]] = field(default_factory=dict)
    _sums: dict[Labels, float] = field(default_factory=dict)

    def observe(self, *labels: str, value: float) -> None:
        """Count one value."""
        counts = self._counts.setdefault(labels, [0] * (len(self.bounds) + 1))
        counts[bisect_left(self.bounds, value)] += 1
        self._sums[labels] = self._sums.get(labels, 0.0) + value

    def lines(self) -> Iterator[str]:
        """As Prometheus reads it: each bucket counts all values up to its bound."""
        yield from _heading(self.name, self.help, "histogram")
        for labels, counts in sorted(self._counts.items()):
            named = list(zip(self.label_names, labels, strict=True))
            total = 0
            for bound, count in zip((*self.bounds, math.inf), counts, strict=True):
                total += count
                yield _line(f"{self.name}_bucket", [*named, ("le", _number(bound))], total)
            yield _line(f"{self.name}_sum", named, self._sums[labels])
            yield _line(f"{self.name}_count", named, total)


Metric = Counter | Gauge | Histogram


def exposition(metrics: Iterable[Metric]) -> str:
    """The page that Prometheus fetches."""
    return "".join(f"{line}\n" for metric in metrics for line in metric.lines())


def _heading(name: str, text: str, kind: str) -> Iterator[str]:
    yield f"# HELP {name} {text}"
    yield f"# TYPE {name} {kind}"


def _line(name: str, labels: Iterable[tuple[str, str]], value: float) -> str:
    shown = ",".join(f'{key}="{_escaped(text)}"' for key, text in labels)
    return f"{name}{{{shown}}} {_number(value)}" if shown else f"{name} {_number(value)}"


def _escaped(text: str) -> str:
    return text.replace("\\", "\\\\").replace("\n", "\\n").replace('"', '\\"')


def _number(value: float) -> str:
    return "+Inf" if value == math.inf else f"{value:.12g}"
