"""Rigorous coupled-wave analysis of one pillar cell.

``solve_textbook_rcwa`` is the plain reference: a page of formulae without symmetries.
``jones`` gives both polarisations of a cell of any shape, lattice and layers,
``jones_derivatives`` also their exact
derivatives by every number of it, ``near_field`` the fields in it, ``solve_row`` the
orders of a row of different pillars.
``solve`` gives the zero-order response with an error estimate, ``solve_many`` shares
the work over diameters. Light comes from the substrate.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
