"""What a command shows: results as lines or JSON, progress with rate and ETA on a
terminal, plain lines otherwise.
"""

import contextlib
import json
import os
import sys
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, TypeVar

from metalens.core.errors import OutputError

Item = TypeVar("Item")


def flush_output(text: str = "") -> None:
    """Write to standard output and flush it; a reader that went away (``| head``) is no
    failure of the work.

    Raises:
        OutputError: it cannot be written otherwise, as to a full disk.
    """
    try:
        sys.stdout.write(text)
        sys.stdout.flush()
    except BrokenPipeError:
        silence_output()
    except OSError as error:
        silence_output()
        raise OutputError(f"standard output: {error.strerror}") from error


def silence_output() -> None:
    """Standard output leads nowhere from here on, what it still holds included."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    with contextlib.suppress(OSError, ValueError):  # one that is no file
        os.dup2(nowhere, sys.stdout.fileno())
    os.close(nowhere)


@dataclass(frozen=True, slots=True)
class Console:
    """Standard output of one command.

    quiet: only errors are shown.
    json: results as one JSON object on standard output; progress is silent.
    """

    quiet: bool = False
    json: bool = False

    def say(self, text: str) -> None:
        """One line for a person."""
        if not (self.quiet or self.json):
            flush_output(text + "\n")

    def result(self, values: dict[str, Any], text: str) -> None:
        """The outcome: ``values`` with --json, else ``text``."""
        if self.json:
            flush_output(json.dumps(values, indent=1, default=float) + "\n")
        else:
            self.say(text)

    def judged(self, values: dict[str, Any], text: str, failures: Iterable[str]) -> int:
        """The outcome with the checks that it failed, in words (``failures`` of the
        values, a line each of the text);
        the status that the command ends with: 1 where any is told, else 0. Empty words
        are no failure."""
        told = [failure for failure in failures if failure]
        self.result(
            values | {"failures": told},
            "\n".join([text, *(f"  FAILED: {failure}" for failure in told)]),
        )
        return 1 if told else 0

    def track(self, items: Iterable[Item], *, total: int, label: str) -> Iterator[Item]:
        """Pass ``items`` through, showing how far it is, the rate and the time left."""
        if self.quiet or self.json:
            yield from items
        elif sys.stdout.isatty():
            yield from _bar(items, total, label)
        else:
            yield from self._lines(items, total, label)

    def _lines(self, items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
        start = shown = time.monotonic()
        for done, item in enumerate(items, 1):
            yield item
            now = time.monotonic()
            if now - shown > 10 or (done == total and now - start > 2):
                rate = done / (now - start)
                left = (total - done) / rate
                self.say(f"{label}: {done}/{total}, {rate:.3g}/s, {left:.0f} s left")
                shown = now


def _bar(items: Iterable[Item], total: int, label: str) -> Iterator[Item]:
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, transient=True) as bar:
        task = bar.add_task(label, total=total, rate="")
        start = time.monotonic()
        for done, item in enumerate(items, 1):
            yield item
            rate = done / max(time.monotonic() - start, 1e-9)
            bar.update(task, advance=1, rate=f"{rate:.3g}/s")
