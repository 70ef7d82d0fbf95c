"""The demo as a list of commands."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.chain import module_view as module_view
    from metalens.chain import stages as stages
    from metalens.chain.stages import ChainFiles as ChainFiles
    from metalens.chain.stages import Stage as Stage

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "ChainFiles": "stages",
        "Stage": "stages",
        "module_view": "",
        "stages": "",
    },
)
