"""The demo as a list of commands."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.chain import module_view as module_view
    from metalens.chain import stages as stages
    from metalens.chain.stages import ChainFiles as ChainFiles
    from metalens.chain.stages import ChainStage as ChainStage

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {"ChainFiles": "stages", "ChainStage": "stages", "module_view": "", "stages": ""},
)
