"""Mask files: the mask in memory, one reader and one writer a format, comparison."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.formats import compare as compare
    from layout.formats import doses as doses
    from layout.formats import dxf as dxf
    from layout.formats import flatten as flatten
    from layout.formats import gdsii_read as gdsii_read
    from layout.formats import gdsii_records as gdsii_records
    from layout.formats import gdsii_write as gdsii_write
    from layout.formats import handover as handover
    from layout.formats import hierarchy as hierarchy
    from layout.formats import oasis_read as oasis_read
    from layout.formats import oasis_records as oasis_records
    from layout.formats import oasis_write as oasis_write
    from layout.formats.assembly import Assembly as Assembly
    from layout.formats.assembly import Copies as Copies
    from layout.formats.assembly import Sites as Sites
    from layout.formats.assembly import arrays as arrays
    from layout.formats.assembly import library_of as library_of
    from layout.formats.compare import Comparison as Comparison
    from layout.formats.content import NOTHING as NOTHING
    from layout.formats.content import QUARTERS as QUARTERS
    from layout.formats.content import CellContent as CellContent
    from layout.formats.content import MaskContent as MaskContent
    from layout.formats.content import Placed as Placed
    from layout.formats.content import Turn as Turn
    from layout.formats.content import mapped as mapped
    from layout.formats.content import placement_limit as placement_limit
    from layout.formats.digest import Digest as Digest
    from layout.formats.digest import Sums as Sums
    from layout.formats.dxf import Window as Window
    from layout.formats.dxf import sites_in as sites_in
    from layout.formats.oasis_cursor import Cursor as Cursor

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Assembly": "assembly",
        "CellContent": "content",
        "Comparison": "compare",
        "Copies": "assembly",
        "Cursor": "oasis_cursor",
        "Digest": "digest",
        "MaskContent": "content",
        "NOTHING": "content",
        "Placed": "content",
        "QUARTERS": "content",
        "Sites": "assembly",
        "Sums": "digest",
        "Turn": "content",
        "Window": "dxf",
        "arrays": "assembly",
        "compare": "",
        "doses": "",
        "dxf": "",
        "flatten": "",
        "gdsii_read": "",
        "gdsii_records": "",
        "gdsii_write": "",
        "handover": "",
        "hierarchy": "",
        "library_of": "assembly",
        "mapped": "content",
        "oasis_read": "",
        "oasis_records": "",
        "oasis_write": "",
        "placement_limit": "content",
        "sites_in": "dxf",
    },
)
