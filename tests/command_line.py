"""The command line as a user types it: in this process, which has its libraries loaded,
or in one of its own.
"""

import contextlib
import io
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from metalens import cli

DONE = subprocess.CompletedProcess[str]


def split_words(parts: tuple[object, ...]) -> list[str]:
    """Words of some parts: text is split at blanks, as a shell does; paths are not."""
    lists = [p.split(" ") if isinstance(p, str) else [str(p)] for p in parts]
    return [word for words in lists for word in words]


def call(*parts: object) -> int:
    """Exit status of ``metalens PARTS``."""
    return cli.main(split_words(parts))


def printed(capsys: pytest.CaptureFixture[str]) -> Any:
    """Values that ``--json`` printed since the last look."""
    return json.loads(capsys.readouterr().out)


def run(*parts: object, cwd: Path | None = None) -> DONE:
    """Exit status and texts of ``metalens PARTS`` in the folder ``cwd``."""
    words = split_words(parts)
    with _streams() as (shown, said), contextlib.chdir(cwd or Path()):
        try:
            status = cli.main(words)
        except SystemExit as end:  # --help
            status = end.code or 0
    return DONE(words, status, shown.getvalue(), said.getvalue())


@contextlib.contextmanager
def _streams() -> Iterator[tuple[io.StringIO, io.StringIO]]:
    with (
        contextlib.redirect_stdout(io.StringIO()) as shown,
        contextlib.redirect_stderr(io.StringIO()) as said,
    ):
        yield shown, said


def process(*parts: object, cwd: Path | None = None) -> DONE:
    """The same by ``python -m metalens``."""
    command = [sys.executable, "-m", "metalens", *split_words(parts)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, check=False)
