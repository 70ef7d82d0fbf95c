"""The verbs of the command line, one module each: ``Options`` and ``run``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from metalens.console import Console
from metalens.errors import ConfigError

Output = Annotated[Path, tyro.conf.arg(aliases=["-o"])]


@dataclass(frozen=True, kw_only=True)
class Common:
    """Options of every verb.

    Attributes:
        quiet: show nothing but errors.
        json: print the result as JSON.
        force: overwrite what exists.
    """

    quiet: bool = False
    json: bool = False
    force: bool = False

    @property
    def console(self) -> Console:
        """Where the verb shows its progress and result."""
        return Console(self.quiet, self.json)

    def claim(self, target: Path) -> Path:
        """``target``, refused where it exists and --force is not given, or where its folder is missing."""
        if target.exists() and not self.force:
            raise ConfigError(f"{target} exists; give --force to overwrite it")
        if not target.parent.is_dir():
            raise ConfigError(f"{target}: folder {target.parent} does not exist")
        return target
