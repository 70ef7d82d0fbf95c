"""Rigorous coupled-wave analysis of one pillar cell.

``solve_textbook_rcwa`` is the plain reference: a page of formulae without symmetries.
``jones`` gives both polarisations of a cell of any shape, lattice and layers,
``jones_derivatives`` also their exact
derivatives by every number of it, ``near_field`` the fields in it, ``solve_row`` the
orders of a row of different pillars.
``solve`` gives the zero-order response with an error estimate, ``solve_many`` shares
the work over diameters. Light comes from the substrate.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.rcwa import anchored as anchored
    from metalens.rcwa import any_shape as any_shape
    from metalens.rcwa import layer as layer
    from metalens.rcwa import made as made
    from metalens.rcwa import pattern as pattern
    from metalens.rcwa import problem as problem
    from metalens.rcwa import stack as stack
    from metalens.rcwa import wall as wall
    from metalens.rcwa.any_shape import SAFETY as SAFETY
    from metalens.rcwa.any_shape import JonesResponse as JonesResponse
    from metalens.rcwa.any_shape import jones as jones
    from metalens.rcwa.any_shape import most_harmonics as most_harmonics
    from metalens.rcwa.near import FieldGrid as FieldGrid
    from metalens.rcwa.near import NearField as NearField
    from metalens.rcwa.near import near_field as near_field
    from metalens.rcwa.near import near_fields as near_fields
    from metalens.rcwa.rates.verb import JonesDerivatives as JonesDerivatives
    from metalens.rcwa.rates.verb import ParameterDerivative as ParameterDerivative
    from metalens.rcwa.rates.verb import jones_derivatives as jones_derivatives
    from metalens.rcwa.reference import OrderResponse as OrderResponse
    from metalens.rcwa.reference import solve_textbook_rcwa as solve_textbook_rcwa
    from metalens.rcwa.supercell import RowResponse as RowResponse
    from metalens.rcwa.supercell import block_of as block_of
    from metalens.rcwa.supercell import solve_row as solve_row
    from metalens.rcwa.verbs import solve as solve
    from metalens.rcwa.verbs import solve_many as solve_many

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "FieldGrid": "near",
        "SAFETY": "any_shape",
        "JonesResponse": "any_shape",
        "anchored": "",
        "any_shape": "",
        "layer": "",
        "made": "",
        "pattern": "",
        "problem": "",
        "stack": "",
        "wall": "",
        "jones": "any_shape",
        "jones_derivatives": "metalens.rcwa.rates.verb",
        "JonesDerivatives": "metalens.rcwa.rates.verb",
        "ParameterDerivative": "metalens.rcwa.rates.verb",
        "NearField": "near",
        "most_harmonics": "any_shape",
        "RowResponse": "supercell",
        "block_of": "supercell",
        "near_field": "near",
        "near_fields": "near",
        "OrderResponse": "reference",
        "solve_textbook_rcwa": "reference",
        "solve": "verbs",
        "solve_many": "verbs",
        "solve_row": "supercell",
    },
)
