from . import interpolant as interpolant
from . import media as media
from . import paths as paths
from .aperture_stop import Stop as Stop
from .layers import Layers as Layers
from .layers import check_gaps as check_gaps
from .media import Media as Media
from .media import saddle_correction as saddle_correction
