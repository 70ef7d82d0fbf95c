"""Diameter map to mask: process, cells, polygons, writers,
readers, checks, solids.

Names load when first used: ``import layout; layout.write_oasis(layout.plan(lens,
process), path)``.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.drc.lattice import check_plan as check_plan
    from layout.formats.compare import compare as compare
    from layout.formats.dxf import write as write_dxf
    from layout.formats.gdsii_read import read as read_gdsii
    from layout.formats.gdsii_write import write as write_gdsii
    from layout.formats.oasis_read import read as read_oasis
    from layout.formats.oasis_write import write as write_oasis
    from layout.mask.build import plan as plan
    from layout.process.process import Process as Process
    from layout.process.process import load as load_process

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Process": "layout.process.process",
        "check_plan": "layout.drc.lattice",
        "compare": "layout.formats.compare",
        "load_process": "layout.process.process:load",
        "plan": "layout.mask.build",
        "read_gdsii": "layout.formats.gdsii_read:read",
        "read_oasis": "layout.formats.oasis_read:read",
        "write_dxf": "layout.formats.dxf:write",
        "write_gdsii": "layout.formats.gdsii_write:write",
        "write_oasis": "layout.formats.oasis_write:write",
    },
)
