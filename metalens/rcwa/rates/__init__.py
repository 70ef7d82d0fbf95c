"""Derivatives of the Jones matrices of any pillar by every number of its shape, section
and material.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.rcwa.rates.verb import JonesDerivatives as JonesDerivatives
    from metalens.rcwa.rates.verb import ParameterDerivative as ParameterDerivative
    from metalens.rcwa.rates.verb import jones_derivatives as jones_derivatives

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "JonesDerivatives": "verb",
        "ParameterDerivative": "verb",
        "jones_derivatives": "verb",
    },
)
