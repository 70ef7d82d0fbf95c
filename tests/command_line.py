"""The command line as a user types it: in this process, which has its libraries loaded,
or in one of its own.
"""

import contextlib
import io
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from metalens import cli

DONE = subprocess.CompletedProcess[str]


def run(*words: object, cwd: Path | None = None) -> DONE:
    """Exit status and texts of ``metalens WORDS`` in the folder ``cwd``."""
    told = [str(word) for word in words]
    with _streams() as (shown, said), contextlib.chdir(cwd or Path()):
        try:
            status = cli.main(told)
        except SystemExit as end:  # --help
            status = end.code or 0
    return DONE(told, status, shown.getvalue(), said.getvalue())


@contextlib.contextmanager
def _streams() -> Iterator[tuple[io.StringIO, io.StringIO]]:
    with (
        contextlib.redirect_stdout(io.StringIO()) as shown,
        contextlib.redirect_stderr(io.StringIO()) as said,
    ):
        yield shown, said


def process(*words: object, cwd: Path | None = None) -> DONE:
    """The same by ``python -m metalens``."""
    command = [sys.executable, "-m", "metalens", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)
