"""Rigorous coupled-wave analysis (RCWA) of one pillar cell, with error estimates.

``solve_textbook_rcwa`` is the plain reference. Light comes from the substrate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
