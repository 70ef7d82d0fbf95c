"""Fourier orders of a square cell under its mirrors, and of any lattice under what it
shares with shape and light.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.rcwa.orders import basis as basis
    from metalens.rcwa.orders import mirrors as mirrors
    from metalens.rcwa.orders import waves as waves

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__, {"basis": "", "mirrors": "", "waves": ""}
)
