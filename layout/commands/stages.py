"""Stages of a command: how long each took, and a line now and then while one takes
longer than two seconds.
"""

import dataclasses
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from layout.mask.plan import MaskPlan, PillarArray
from metalens.core.arrays import Array

_FIRST_S, _NEXT_S = 2.0, 10.0


class RowProgress:
    """How far down the lens the stage is that works on it."""

    def __init__(self) -> None:
        self.end, self.total, self.start = 0, 0, 0.0
        self._lens: PillarArray | None = None

    def watched(self, plan: MaskPlan) -> MaskPlan:
        """``plan``, whose first lattice tells when blocks of its rows are taken."""
        lens = self._lens = plan.lattices[0]
        self.total = lens.rows

        def source(first: int, end: int) -> Array:
            if first < self.end or not self.end:  # another pass
                self.start = time.monotonic()
            self.end = end
            return lens.source(first, end)

        lattice: PillarArray = dataclasses.replace(lens, source=source)
        return plan.replace(lattices=(lattice, *plan.lattices[1:]))

    def unwatched(self, plan: MaskPlan) -> MaskPlan:
        """A watched plan as it was, for work outside the stages."""
        return (
            plan
            if self._lens is None
            else plan.replace(lattices=(self._lens, *plan.lattices[1:]))
        )

    @property
    def text(self) -> str:
        """Share of the rows and time left; empty before the first."""
        if not 0 < self.end < self.total:
            return ""
        spent = time.monotonic() - self.start
        left = spent * (self.total - self.end) / self.end
        rate = self.end / max(spent, 1e-9)
        return f", {100 * self.end / self.total:.0f} % of the rows, {rate:.3g} rows/s, {left:.0f} s left"


class StageTimes:
    """Times of the stages; ``say`` hears of those that last."""

    def __init__(
        self,
        say: Callable[[str], None],
        *,
        first_s: float = _FIRST_S,
        next_s: float = _NEXT_S,
    ) -> None:
        self.seconds: dict[str, float] = {}
        self.rows = RowProgress()
        self._say = say
        self._waits = (first_s, next_s)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        """Time what happens inside as ``stage``."""
        start = time.perf_counter()
        over = threading.Event()
        self.rows.end = 0
        ticker = threading.Thread(
            target=self._tick, args=(stage, start, over), daemon=True
        )
        ticker.start()
        try:
            yield
        finally:
            over.set()
            ticker.join()
            self.seconds[stage] = time.perf_counter() - start

    def _tick(self, stage: str, start: float, over: threading.Event) -> None:
        """Report a stage that lasts: after the first wait, then at every next wait."""
        wait, next_wait = self._waits
        while not over.wait(wait):
            self._say(f"{stage}: {time.perf_counter() - start:.0f} s{self.rows.text}")
            wait = next_wait
