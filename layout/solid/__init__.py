"""STEP, STL, 3MF, glTF."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.solid import files as files

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "files": "",
    },
)
