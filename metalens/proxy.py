"""The proxy of a pillar: phase and transmission as polynomials of the diameter (paper
Eq. 2).
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.pillars.fit import Wanted as Wanted
    from metalens.pillars.fit import fit_proxy as fit
    from metalens.pillars.proxy import Proxy as Proxy

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Proxy": "metalens.pillars.proxy",
        "Wanted": "metalens.pillars.fit",
        "fit": "metalens.pillars.fit:fit_proxy",
    },
)
