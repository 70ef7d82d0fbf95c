"""A modal method for round pillars: exact along z, elements that follow the disc across.

``solve`` gives one response with its error estimate, ``solve_many`` a table over diameters, wavelengths, angles and
polarisations, ``gradient`` the exact derivatives of t.
"""

from metalens.modal.derivatives import Gradient, gradient
from metalens.modal.engine import solve
from metalens.modal.table import Table, solve_many

__all__ = ["Gradient", "Table", "gradient", "solve", "solve_many"]
