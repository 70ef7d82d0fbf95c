"""Verbs of the optics core."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.commands.common import MASKS as MASKS
    from metalens.commands.common import CommonOptions as CommonOptions
    from metalens.commands.common import DistributedOptions as DistributedOptions
    from metalens.commands.common import MaybeOutput as MaybeOutput
    from metalens.commands.common import Output as Output

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CommonOptions": "common",
        "DistributedOptions": "common",
        "MASKS": "common",
        "MaybeOutput": "common",
        "Output": "common",
    },
)
