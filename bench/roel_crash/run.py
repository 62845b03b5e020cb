"""Kill after kill, with a check after each."""

from __future__ import annotations

import random
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from roel_client import Client, RetryPolicy
from roel_crash.checker import Checker
from roel_crash.ledger import Ledger
from roel_crash.victim import Victim
from roel_service.failpoints import FAILPOINTS
from roel_service.store.fsck import check_folder
from roel_service.store.records import OperationState
from roel_service.store.store import Store

# A named step that is not met within this time is not part of what the checkers do just then.
STEP_TIMEOUT_S = 15.0
# Steps that are met at every start, and one that ends an operation when every attempt dies there:
# now and then one is survived.
SURVIVED = {"rows.written": 0.1, "rows.committed": 0.1, "stage.cached": 0.5}
# A run that is long enough for it goes on until every named step was met so often, and as many kills
# struck as were asked for; at most for so many kills more.
LEAST_STEP_KILLS = 3
MAX_EXTRA_KILLS = 60
LONGEST_LIFE_S = 2.5

CHECKER_COUNT = 2
# Of each kind are asked for after a kill, and everything at the end: asking for all each time would
# take longer than all the rest.
NEWEST_COUNT = 10

# What is counted of a kill for which there was no occasion.
NOT_MET = " (not met)"

# Connections of one process share how long they wait before they try again: up to some seconds.
PATIENT = RetryPolicy(attempt_count=30, longest_pause_s=1.0)


@dataclass
class Outcome:
    """What came of it.

    Attributes:
        kills: by what was killed, and where.
        broken: promises that were not kept; problems that a check of the folder found.
    """

    seed: int
    kills: Counter[str] = field(default_factory=Counter)
    broken: list[str] = field(default_factory=list)
    ends: Counter[str] = field(default_factory=Counter)
    event_count: int = 0
    recording_count: int = 0
    map_count: int = 0
    blob_count: int = 0
    longest_restart_s: float = 0.0
    seconds: float = 0.0

    @property
    def missed(self) -> list[str]:
        """Named steps at which nothing died."""
        return [step for step in FAILPOINTS if not self.kills[step]]

    def document(self) -> dict[str, Any]:
        """All of it, for JSON."""
        return {**vars(self), "kill_count": self.kill_count, "missed": self.missed}

    @property
    def kill_count(self) -> int:
        """Of those that struck."""
        return sum(count for name, count in self.kills.items() if not name.endswith(NOT_MET))


@dataclass(frozen=True, kw_only=True)
class Kill:
    """One kill.

    Attributes:
        name: what is counted.
        failpoint: for the server's environment; empty for a kill from outside.
    """

    name: str
    failpoint: str
    strike: Callable[[Victim], bool]


def plan(kill_count: int, rng: random.Random) -> Iterator[Kill]:
    """Servers at random moments and at every named step in turn, and children.

    A named step follows a server's death, because it belongs to the environment of the next one.
    """
    for index in range(kill_count):
        kind = index % 3
        if kind == 0:
            yield _kill_of_server(rng)
        elif kind == 1:
            yield _kill_at_step(FAILPOINTS[index // 3 % len(FAILPOINTS)])
        else:
            yield Kill(name="child", failpoint="", strike=_child_after(_life_s(rng)))


def _kill_of_server(rng: random.Random) -> Kill:
    return Kill(name="server", failpoint="", strike=_after(_life_s(rng)))


def _kill_at_step(step: str) -> Kill:
    condition = f"{step}:exit@{SURVIVED.get(step, 1.0)}"
    return Kill(name=step, failpoint=condition, strike=_at_step(step))


def _life_s(rng: random.Random) -> float:
    return rng.uniform(0.05, LONGEST_LIFE_S)


def crash(
    folder: Path, kill_count: int, seed: int, log: IO[bytes], checker_count: int = CHECKER_COUNT
) -> Outcome:
    """Kill a server so many times; what it did not keep.

    Args:
        folder: of its data; new.
        log: what the servers write to stderr.
    """
    began_s = time.monotonic()
    outcome, ledger, rng = Outcome(seed=seed), Ledger(), random.Random(seed)
    victim = Victim(folder, 0, log)
    port = victim.port
    checkers = [Checker(f"127.0.0.1:{port}", ledger, seed + k) for k in range(checker_count)]
    for checker in checkers:
        checker.start()
    kills = deque(plan(kill_count, rng))
    most_kills = kill_count + MAX_EXTRA_KILLS
    while kills:
        kill = kills.popleft()
        outcome.kills[kill.name if kill.strike(victim) else f"{kill.name}{NOT_MET}"] += 1
        if not kills and outcome.kills.total() < most_kills:
            kills += _missing(outcome, kill_count, rng)
        following = kills[0].failpoint if kills else ""
        if victim.is_dead_within(0):
            outcome.broken += check_folder(folder).problems
            victim = _restarted(folder, port, log, outcome, following)
        if not following:
            with Client(f"127.0.0.1:{port}", retry=PATIENT, timeout_s=60.0) as client:
                ledger.check(client, NEWEST_COUNT)
    for checker in checkers:
        checker.end()
    with Client(f"127.0.0.1:{port}", retry=PATIENT, timeout_s=60.0) as client:
        ledger.check(client)
    if victim.stop() != 0:
        outcome.broken.append("the last server did not drain")
    outcome.broken += ledger.broken + check_folder(folder).problems + _unended(folder, ledger)
    outcome.ends.update(ledger.ends.values())
    outcome.event_count = sum(ledger.events.values())
    outcome.recording_count, outcome.map_count = len(ledger.digests), len(ledger.maps)
    outcome.blob_count = len(ledger.blobs)
    outcome.seconds = time.monotonic() - began_s
    return outcome


def _missing(outcome: Outcome, kill_count: int, rng: random.Random) -> list[Kill]:
    """What a run that was to have so many kills lacks; each step after a server's death."""
    each_count = min(LEAST_STEP_KILLS, kill_count // (3 * len(FAILPOINTS)))
    scarce = [step for step in FAILPOINTS if outcome.kills[step] < each_count]
    if scarce:
        return [kill for step in scarce for kill in (_kill_of_server(rng), _kill_at_step(step))]
    return [_kill_of_server(rng)] if outcome.kill_count < kill_count else []


def _unended(folder: Path, ledger: Ledger) -> list[str]:
    """Operations whose row says something else than their watcher was told."""
    with Store(folder) as store:
        rows = store.operations.page("", 1_000_000)
    states = {f"operations/{row.id}": row.state for row in rows}
    told = {
        name: OperationState.SUCCEEDED if end == "SUCCEEDED" else OperationState.FAILED
        for name, end in ledger.ends.items()
    }
    return [
        f"{name}: told {told[name]}, is {states.get(name)}"
        for name in told
        if states.get(name) is not told[name]
    ]


def _restarted(folder: Path, port: int, log: IO[bytes], outcome: Outcome, failpoint: str) -> Victim:
    began_s = time.monotonic()
    started = Victim(folder, port, log, failpoint)
    outcome.longest_restart_s = max(outcome.longest_restart_s, time.monotonic() - began_s)
    return started


def _after(life_s: float) -> Callable[[Victim], bool]:
    def strike(victim: Victim) -> bool:
        time.sleep(life_s)
        victim.kill()
        return victim.is_dead_within(60)

    return strike


def _at_step(step: str) -> Callable[[Victim], bool]:
    """A server that dies there, or whose child does; it is killed in any case."""

    def strike(victim: Victim) -> bool:
        deadline_s = time.monotonic() + STEP_TIMEOUT_S
        while not victim.has_met(step) and time.monotonic() < deadline_s:
            time.sleep(0.05)
        victim.kill()
        victim.is_dead_within(60)
        return victim.has_met(step)

    return strike


def _child_after(life_s: float) -> Callable[[Victim], bool]:
    def strike(victim: Victim) -> bool:
        time.sleep(life_s)
        deadline_s = time.monotonic() + STEP_TIMEOUT_S
        while not victim.kill_a_child():
            if time.monotonic() > deadline_s:
                return False
            time.sleep(0.01)
        return True

    return strike
