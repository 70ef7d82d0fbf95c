"""Verbs of the optics core."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.commands.common import MASKS as MASKS
    from metalens.commands.common import Common as Common
    from metalens.commands.common import Distributed as Distributed
    from metalens.commands.common import MaybeOutput as MaybeOutput
    from metalens.commands.common import Output as Output

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Common": "common",
        "Distributed": "common",
        "MASKS": "common",
        "MaybeOutput": "common",
        "Output": "common",
    },
)
