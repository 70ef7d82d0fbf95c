"""What both formats share: content, read loops, comparison, DXF."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.files import doses as doses
    from layout.files import dxf as dxf
    from layout.files import flat as flat
    from layout.files import handover as handover
    from layout.files import hierarchy as hierarchy
    from layout.files import paths as paths
    from layout.files import squares as squares
    from layout.files import verify as verify
    from layout.files.assembly import Assembly as Assembly
    from layout.files.assembly import Copies as Copies
    from layout.files.assembly import Sites as Sites
    from layout.files.assembly import arrays as arrays
    from layout.files.content import CONTEXT_CELL as CONTEXT_CELL
    from layout.files.content import NOTHING as NOTHING
    from layout.files.content import QUARTERS as QUARTERS
    from layout.files.content import CellContent as CellContent
    from layout.files.content import Gathered as Gathered
    from layout.files.content import MaskContent as MaskContent
    from layout.files.content import Placed as Placed
    from layout.files.content import Turn as Turn
    from layout.files.content import decode_name as decode_name
    from layout.files.content import forget as forget
    from layout.files.content import has_area as has_area
    from layout.files.content import mapped as mapped
    from layout.files.content import placement_limit as placement_limit
    from layout.files.digest import Digest as Digest
    from layout.files.digest import Sums as Sums
    from layout.files.dxf import Window as Window
    from layout.files.dxf import sites_in as sites_in
    from layout.files.read_loops import FARTHEST as FARTHEST
    from layout.files.read_loops import deltas as deltas
    from layout.files.read_loops import placements as placements
    from layout.files.read_loops import sref_run as sref_run

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Assembly": "assembly",
        "CONTEXT_CELL": "content",
        "CellContent": "content",
        "Copies": "assembly",
        "Digest": "digest",
        "FARTHEST": "read_loops",
        "Gathered": "content",
        "MaskContent": "content",
        "NOTHING": "content",
        "Placed": "content",
        "QUARTERS": "content",
        "Sites": "assembly",
        "Sums": "digest",
        "Turn": "content",
        "Window": "dxf",
        "arrays": "assembly",
        "decode_name": "content",
        "deltas": "read_loops",
        "doses": "",
        "dxf": "",
        "flat": "",
        "forget": "content",
        "handover": "",
        "has_area": "content",
        "hierarchy": "",
        "mapped": "content",
        "paths": "",
        "placement_limit": "content",
        "placements": "read_loops",
        "sites_in": "dxf",
        "squares": "",
        "sref_run": "read_loops",
        "verify": "",
    },
)
