"""Path-traced frames (optional extra)."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.referee import pathtraced as pathtraced

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "pathtraced": "",
    },
)
