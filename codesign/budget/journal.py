"""Parts of a long piece of work that are done, kept beside its output, so that an
interrupted run goes on.
"""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from metalens.ground import manifest, reading, store


class Journal:
    """Finished parts as JSON lines, each on the disk when its part is done; numbers
    come back bit for bit.

    The first line names the work; a file of other work is started afresh, a line that
    was cut short is dropped.

    path: None keeps nothing. title: all that the parts follow from, the version first.
    inputs: files that each part
    reads anew.

    Raises:
        StoreError: a file that is no journal stands there; later, that an input was
            replaced.
    """

    def __init__(
        self, path: Path | None = None, title: str = "", *, inputs: Iterable[Path] = ()
    ) -> None:
        self._path, self._known = path, dict[str, Any]()
        self._read = {file: reading.stamp(file) for file in inputs}
        if path is None:
            return
        self._known = dict(
            found
            for line in manifest.journal(path, json.dumps(title))
            if (found := _part(line))
        )

    def part(self, name: str, work: Callable[[], Any]) -> Any:
        """What ``work`` returns, or returned in an earlier run: numbers, words, lists."""
        if name not in self._known:
            value = work()
            for file, before in self._read.items():
                reading.check_same(file, before)
            if self._path is not None:
                store.append_line(self._path, json.dumps([name, value]))
            self._known[name] = value
        return self._known[name]

    def finish(self) -> None:
        """All is done: the journal is no longer needed."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)


def _part(line: str) -> tuple[str, Any] | None:
    """(name, value) of a line; None for a damaged one, whose part is done again."""
    try:
        name, value = json.loads(line)
    except (ValueError, TypeError, RecursionError):
        return None
    return str(name), value
