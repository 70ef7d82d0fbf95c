"""Rigorous coupled-wave analysis (RCWA) of one pillar cell.

``solve`` gives the zero-order response with an error estimate, ``jones`` both
polarisations, ``near_field`` the fields in the cell, ``solve_row`` the orders of a row
of different pillars. ``solve_textbook_rcwa`` is the plain reference: a page of formulae
without symmetries. Light comes from the substrate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
