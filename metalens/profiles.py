"""Phase profiles: hyperbolic, double helix, cubic, own map."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.design.profiles import Cubic as Cubic
    from metalens.design.profiles import DoubleHelix as DoubleHelix
    from metalens.design.profiles import Focus as Focus
    from metalens.design.profiles import PhaseMap as PhaseMap
    from metalens.design.profiles import cubic as cubic
    from metalens.design.profiles import double_helix as double_helix
    from metalens.design.profiles import hyperbolic as hyperbolic
    from metalens.ground.paths import path_difference as path_difference

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Cubic": "metalens.design.profiles",
        "DoubleHelix": "metalens.design.profiles",
        "Focus": "metalens.design.profiles",
        "PhaseMap": "metalens.design.profiles",
        "cubic": "metalens.design.profiles",
        "double_helix": "metalens.design.profiles",
        "hyperbolic": "metalens.design.profiles",
        "path_difference": "metalens.ground.paths",
    },
)
