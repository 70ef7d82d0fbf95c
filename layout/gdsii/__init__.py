"""GDSII: bytes, reader, streaming writer."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.gdsii import assemble as assemble
    from layout.gdsii import bytes as bytes
    from layout.gdsii import read as read
    from layout.gdsii import write as write

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "assemble": "",
        "bytes": "",
        "read": "",
        "write": "",
    },
)
