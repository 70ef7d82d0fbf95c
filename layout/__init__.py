"""Diameter map to mask: process, cells, polygons, writers,
readers, checks, solids.

Names load when first used: ``import layout; layout.write_oasis(layout.plan(lens,
process), path)``.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.drc.lattice import check_plan as check_plan
    from layout.files.dxf import write as write_dxf
    from layout.files.verify import compare as compare
    from layout.gdsii.read import read as read_gdsii
    from layout.gdsii.write import write as write_gdsii
    from layout.mask.build import plan as plan
    from layout.oasis.read import read as read_oasis
    from layout.oasis.write import write as write_oasis
    from layout.process.process import Process as Process
    from layout.process.process import load as load_process

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Process": "layout.process.process",
        "check_plan": "layout.drc.lattice",
        "compare": "layout.files.verify",
        "load_process": "layout.process.process:load",
        "plan": "layout.mask.build",
        "read_gdsii": "layout.gdsii.read:read",
        "read_oasis": "layout.oasis.read:read",
        "write_dxf": "layout.files.dxf:write",
        "write_gdsii": "layout.gdsii.write:write",
        "write_oasis": "layout.oasis.write:write",
    },
)
