"""What the process spread does to the light."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.study import page as page
    from layout.study.focus import check as check

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "check": "focus",
        "page": "",
    },
)
