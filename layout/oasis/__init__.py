"""OASIS: bytes, reader, streaming writer."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.oasis import assemble as assemble
    from layout.oasis import bytes as bytes
    from layout.oasis import read as read
    from layout.oasis import write as write
    from layout.oasis.cursor import Cursor as Cursor
    from layout.oasis.tiles import count_classes as count_classes

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Cursor": "cursor",
        "assemble": "",
        "bytes": "",
        "count_classes": "tiles",
        "read": "",
        "write": "",
    },
)
