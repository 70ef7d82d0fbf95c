"""Rigorous coupled-wave analysis of one pillar cell.

``jones`` gives both polarisations of a cell of any shape, lattice and layers. ``solve`` gives the zero-order response
with an error estimate, ``solve_many`` shares the work over diameters, ``derivatives`` differentiates it exactly (round
pillars). Light comes from the substrate.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.rcwa import anchored as anchored
    from metalens.rcwa.any_shape import SAFETY as SAFETY
    from metalens.rcwa.any_shape import Jones as Jones
    from metalens.rcwa.any_shape import jones as jones
    from metalens.rcwa.any_shape import most_harmonics as most_harmonics
    from metalens.rcwa.verbs import derivatives as derivatives
    from metalens.rcwa.verbs import solve as solve
    from metalens.rcwa.verbs import solve_many as solve_many

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "SAFETY": "any_shape",
        "Jones": "any_shape",
        "anchored": "",
        "derivatives": "verbs",
        "jones": "any_shape",
        "most_harmonics": "any_shape",
        "solve": "verbs",
        "solve_many": "verbs",
    },
)
