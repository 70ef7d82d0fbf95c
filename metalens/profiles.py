"""Phase profiles: hyperbolic, double helix, cubic, own map."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.core.paths import path_difference as path_difference
    from metalens.design.profiles import Cubic as Cubic
    from metalens.design.profiles import DoubleHelix as DoubleHelix
    from metalens.design.profiles import Focus as Focus
    from metalens.design.profiles import PhaseMap as PhaseMap
    from metalens.design.profiles import cubic_phase as cubic_phase
    from metalens.design.profiles import double_helix_phase as double_helix_phase
    from metalens.design.profiles import hyperbolic_phase as hyperbolic_phase

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Cubic": "metalens.design.profiles",
        "DoubleHelix": "metalens.design.profiles",
        "Focus": "metalens.design.profiles",
        "PhaseMap": "metalens.design.profiles",
        "cubic_phase": "metalens.design.profiles",
        "double_helix_phase": "metalens.design.profiles",
        "hyperbolic_phase": "metalens.design.profiles",
        "path_difference": "metalens.core.paths",
    },
)
