"""The proxy of a pillar: phase and transmission as polynomials of the diameter (paper
Eq. 2).
"""

from metalens.library.fit import ProxyTolerances as ProxyTolerances
from metalens.library.fit import fit_proxy
from metalens.library.proxy import Proxy as Proxy

fit = fit_proxy
