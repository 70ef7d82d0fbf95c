from . import neighbours as neighbours
from . import profiles as profiles
from .assign import ConversionMetrics as ConversionMetrics
from .assign import DesignMetrics as DesignMetrics
from .assign import Limits as Limits
from .assign import PolarizationMetrics as PolarizationMetrics
from .assign import WavelengthTarget as WavelengthTarget
from .assign import assign_geometric_phase as assign_geometric_phase
from .assign import assign_multi_wavelength as assign_multi_wavelength
from .assign import assign_polarization_multiplexed as assign_polarization_multiplexed
from .assign import make as make
from .assign import phase_coverage_hint as phase_coverage_hint
from .assign import phase_of as phase_of
from .focus_check import FocusCheck as FocusCheck
from .focus_check import check_focus as check_focus
from .focusing import field_angle as field_angle
from .focusing import has_focus as has_focus
from .focusing import lens_has_focus as lens_has_focus
from .focusing import lens_meeting_um as lens_meeting_um
from .focusing import meeting_um as meeting_um
from .own_cell import NeighbourCouplingLoss as NeighbourCouplingLoss
from .own_cell import (
    estimate_neighbour_coupling_loss as estimate_neighbour_coupling_loss,
)
from .own_cell import neighbour_coupling_loss as neighbour_coupling_loss
from .own_cell import power_error as power_error
from .own_cell import solve_coupling_rows as solve_coupling_rows
from .profiles import Cubic as Cubic
from .profiles import DoubleHelix as DoubleHelix
from .profiles import Focus as Focus
from .profiles import PhaseMap as PhaseMap
from .profiles import hyperbolic_phase as hyperbolic_phase
from .profiles import lens_focus as lens_focus
from .profiles import vortex_phase as vortex_phase
from .sites import PhaseOf as PhaseOf
