"""Pillar libraries: sweep a cell over diameter, wavelength, angle and polarisation;
keep it as a file.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.pillars.fit import proxy_of as proxy_of
    from metalens.pillars.record import DEFAULT_CELL as DEFAULT_CELL
    from metalens.pillars.record import PillarLibrary as PillarLibrary
    from metalens.pillars.record import Sweep as Sweep
    from metalens.pillars.record import check_sweep as check_sweep
    from metalens.pillars.record import load as load
    from metalens.pillars.record import save as save
    from metalens.pillars.sweep import sweep as sweep

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "DEFAULT_CELL": "metalens.pillars.record",
        "PillarLibrary": "metalens.pillars.record",
        "Sweep": "metalens.pillars.record",
        "check_sweep": "metalens.pillars.record",
        "load": "metalens.pillars.record",
        "proxy_of": "metalens.pillars.fit",
        "save": "metalens.pillars.record",
        "sweep": "metalens.pillars.sweep",
    },
)
