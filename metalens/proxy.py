"""The proxy of a pillar: phase and transmission as polynomials of the diameter (paper
Eq. 2).
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.library.fit import ProxyTolerances as ProxyTolerances
    from metalens.library.fit import fit_proxy as fit
    from metalens.library.proxy import Proxy as Proxy

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Proxy": "metalens.library.proxy",
        "ProxyTolerances": "metalens.library.fit",
        "fit": "metalens.library.fit:fit_proxy",
    },
)
