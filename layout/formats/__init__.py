"""Mask files: the mask in memory, one reader and one writer a format, comparison."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

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
    from layout.formats.assembly import CellCopies as CellCopies
    from layout.formats.assembly import MaskAssembly as MaskAssembly
    from layout.formats.assembly import PillarSites as PillarSites
    from layout.formats.assembly import find_arrays as find_arrays
    from layout.formats.assembly import library_of as library_of
    from layout.formats.compare import ReadbackComparison as ReadbackComparison
    from layout.formats.content import NOTHING as NOTHING
    from layout.formats.content import QUARTERS as QUARTERS
    from layout.formats.content import CellContent as CellContent
    from layout.formats.content import CellPlacements as CellPlacements
    from layout.formats.content import MaskContent as MaskContent
    from layout.formats.content import Orientation as Orientation
    from layout.formats.content import map_bytes as map_bytes
    from layout.formats.content import placement_limit as placement_limit
    from layout.formats.digest import PlacementDigest as PlacementDigest
    from layout.formats.digest import RunningDigest as RunningDigest
    from layout.formats.dxf import DxfWindow as DxfWindow
    from layout.formats.dxf import sites_in as sites_in
    from layout.formats.oasis_cursor import ByteCursor as ByteCursor

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "MaskAssembly": "assembly",
        "CellContent": "content",
        "ReadbackComparison": "compare",
        "CellCopies": "assembly",
        "ByteCursor": "oasis_cursor",
        "RunningDigest": "digest",
        "MaskContent": "content",
        "NOTHING": "content",
        "CellPlacements": "content",
        "QUARTERS": "content",
        "PillarSites": "assembly",
        "PlacementDigest": "digest",
        "Orientation": "content",
        "DxfWindow": "dxf",
        "find_arrays": "assembly",
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
        "map_bytes": "content",
        "oasis_read": "",
        "oasis_records": "",
        "oasis_write": "",
        "placement_limit": "content",
        "sites_in": "dxf",
    },
)
