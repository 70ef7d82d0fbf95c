"""The verbs of the command line, one module each: ``Options`` and ``run``."""

import contextlib
import dataclasses
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from metalens.core import executor, transaction
from metalens.core.report import CommandConsole
from metalens.core.transaction import ClaimTerms, OutputDraft

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]
MASKS = (
    ".oas",
    ".oasis",
    ".gds",
    ".gdsii",
)  # endings of mask files, OASIS before GDSII
MaybeOutput = Annotated[Path | None, tyro.conf.arg(aliases=["-o"])]


@dataclass(frozen=True, kw_only=True)
class CommonOptions:
    """Options of every verb.

    Attributes:
        quiet: show nothing but errors.
        json: print the result as JSON.
        force: replace what exists; a folder only if this toolchain wrote it.
    """

    quiet: bool = False
    json: bool = False
    force: bool = False

    @property
    def console(self) -> CommandConsole:
        """Where the verb shows its progress and result."""
        return CommandConsole(self.quiet, self.json)

    def claim(
        self,
        target: Path,
        *,
        companions: Sequence[str] = (),
        inputs: Sequence[Path] = (),
    ) -> contextlib.AbstractContextManager[OutputDraft]:
        """Context that claims a file and its companions before the work.

        They appear together at the end of the block, or not at all.

        Args:
            target: file to write.
            companions: endings of the companions, as ``_xz.png``.
            inputs: files that are read, in addition to those that the options name.

        Raises:
            OutputError: see :func:`metalens.core.transaction.claim_file`.
        """
        return transaction.claim_file(
            target, companions=companions, terms=self._terms(inputs)
        )

    def claim_folder(
        self, target: Path, *, inputs: Sequence[Path] = ()
    ) -> contextlib.AbstractContextManager[OutputDraft]:
        """Context that claims a folder before the work.

        It appears whole with its manifest at the end of the block, or not at all.

        Args:
            target: folder to write.
            inputs: files that are read, in addition to those that the options name.

        Raises:
            OutputError: see :func:`metalens.core.transaction.claim_folder`.
        """
        return transaction.claim_folder(target, terms=self._terms(inputs))

    def claim_work(
        self,
        target: Path,
        *,
        keep: Sequence[str],
        resume: bool = False,
        grow: bool = False,
    ) -> contextlib.AbstractContextManager[OutputDraft]:
        """Context that claims a folder for long work, which can be resumed when
        interrupted.

        Args:
            target: folder to write.
            keep: names of files that survive an interruption.
            resume: continue the work in the folder.
            grow: add to a finished folder.

        Raises:
            OutputError: see :func:`metalens.core.transaction.claim_long_work`.
        """
        terms = dataclasses.replace(self._terms(), parents=True)
        return transaction.claim_long_work(
            target, keep=keep, resume=resume, grow=grow, terms=terms
        )

    def _terms(self, inputs: Sequence[Path] = ()) -> ClaimTerms:
        return ClaimTerms(force=self.force, inputs=(*self._paths(), *inputs))

    def _paths(self) -> Iterator[Path]:
        """Every path among the options that is read."""
        for field in dataclasses.fields(self):
            value = getattr(self, field.name)
            if field.name != "output":
                values = value if isinstance(value, tuple) else (value,)
                yield from (v for v in values if isinstance(v, Path))


@dataclass(frozen=True, kw_only=True)
class DistributedOptions(CommonOptions):
    """Options of verbs whose work is spread over processes; the result is the same for
    any number of them.

    Attributes:
        workers: processes of this machine that do the work; left out: as many as it has
            cores.
    """

    workers: int | None = None

    def shared(self) -> contextlib.AbstractContextManager[None]:
        """Where the work of the block is done.

        Raises:
            ConfigError, WorkerError: see :func:`metalens.core.executor.run_on`.
        """
        return executor.run_on(self.workers)
