"""Benchmarks: every row prints a time beside an error, and what the error is measured
against.

A topic is a module of ``speed`` (what every release must keep), ``peers`` (other
people's methods and projects) or ``studies`` (are error bars honest, what is the model
worth) with ``rows() -> list[Row]`` (or an iterator, whose rows are shown as they come),
and, where it compares with other projects, ``peer_rows() -> list[Row]`` (run by
``make bench-peers`` in an environment of their own).
"""

import time
from collections.abc import Callable
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a speed-against-error table.

    case, method: what was computed, and how.
    seconds: of the fastest of a few repeats.
    error: in the unit that ``against`` names; nan where the row has none (say so in
    ``against``).
    against: the reference of the error.
    peak_mb: memory above the inputs, nan where not measured.
    goal: the number that was asked for, and whether it is met, in words.
    """

    case: str
    method: str
    seconds: float
    error: float
    against: str
    threads: int = 1
    peak_mb: float = float("nan")
    goal: str = ""


def fastest(work: Callable[[], object], *, repeats: int = 3) -> float:
    """Seconds of the fastest of ``repeats`` calls, after one call that warms caches."""
    work()
    best = float("inf")
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        best = min(best, time.perf_counter() - start)
    return best
