"""Diameter map to mask: process, cells, polygons, writers,
readers, checks, solids.

Names load when first used: ``import layout; layout.write_oasis(layout.plan(lens,
process), path)``.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
