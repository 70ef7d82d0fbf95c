"""Phase profiles: hyperbolic, double helix, cubic, own map."""

from metalens.design.profiles import Cubic as Cubic
from metalens.design.profiles import DoubleHelix as DoubleHelix
from metalens.design.profiles import Focus as Focus
from metalens.design.profiles import PhaseMap as PhaseMap
from metalens.design.profiles import cubic_phase as cubic_phase
from metalens.design.profiles import double_helix_phase as double_helix_phase
from metalens.design.profiles import hyperbolic_phase as hyperbolic_phase
from metalens.optics.paths import path_difference as path_difference
