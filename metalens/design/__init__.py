"""A wanted phase made of pillars, and the check that it focuses."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.design import neighbours as neighbours
    from metalens.design import profiles as profiles
    from metalens.design.focus_check import FocusCheck as FocusCheck
    from metalens.design.focus_check import check_focus as check_focus
    from metalens.design.focus_check import focus_figures as focus_figures
    from metalens.design.focusing import focused as focused
    from metalens.design.focusing import focuses as focuses
    from metalens.design.focusing import lens_meeting_um as lens_meeting_um
    from metalens.design.focusing import meeting_um as meeting_um
    from metalens.design.of_phase import Limits as Limits
    from metalens.design.of_phase import Quality as Quality
    from metalens.design.of_phase import field_angle as field_angle
    from metalens.design.of_phase import make as make
    from metalens.design.of_phase import phase_coverage_hint as phase_coverage_hint
    from metalens.design.of_phase import phase_of as phase_of
    from metalens.design.own_cell import NeighbourCouplingLoss as NeighbourCouplingLoss
    from metalens.design.own_cell import (
        estimate_neighbour_coupling_loss as estimate_neighbour_coupling_loss,
    )
    from metalens.design.own_cell import left_out as left_out
    from metalens.design.own_cell import (
        neighbour_coupling_loss as neighbour_coupling_loss,
    )
    from metalens.design.own_cell import power_error as power_error
    from metalens.design.own_cell import solve_coupling_rows as solve_coupling_rows
    from metalens.design.paired import PolarizationMetrics as PolarizationMetrics
    from metalens.design.paired import (
        assign_polarization_multiplexed as assign_polarization_multiplexed,
    )
    from metalens.design.profiles import Cubic as Cubic
    from metalens.design.profiles import DoubleHelix as DoubleHelix
    from metalens.design.profiles import Focus as Focus
    from metalens.design.profiles import PhaseMap as PhaseMap
    from metalens.design.profiles import hyperbolic_phase as hyperbolic_phase
    from metalens.design.several import WavelengthTarget as WavelengthTarget
    from metalens.design.several import (
        assign_multi_wavelength as assign_multi_wavelength,
    )
    from metalens.design.sites import PhaseOf as PhaseOf
    from metalens.design.turned import ConversionMetrics as ConversionMetrics
    from metalens.design.turned import assign_geometric_phase as assign_geometric_phase

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "ConversionMetrics": "turned",
        "Cubic": "profiles",
        "DoubleHelix": "profiles",
        "Focus": "profiles",
        "FocusCheck": "focus_check",
        "Limits": "of_phase",
        "PhaseMap": "profiles",
        "PhaseOf": "sites",
        "Quality": "of_phase",
        "PolarizationMetrics": "paired",
        "NeighbourCouplingLoss": "own_cell",
        "WavelengthTarget": "several",
        "check_focus": "focus_check",
        "phase_coverage_hint": "of_phase",
        "field_angle": "of_phase",
        "focus_figures": "focus_check",
        "focused": "focusing",
        "focuses": "focusing",
        "lens_meeting_um": "focusing",
        "meeting_um": "focusing",
        "hyperbolic_phase": "profiles",
        "left_out": "own_cell",
        "make": "of_phase",
        "assign_polarization_multiplexed": "paired",
        "assign_multi_wavelength": "several",
        "assign_geometric_phase": "turned",
        "neighbours": "",
        "phase_of": "of_phase",
        "profiles": "",
        "power_error": "own_cell",
        "estimate_neighbour_coupling_loss": "own_cell",
        "solve_coupling_rows": "own_cell",
        "neighbour_coupling_loss": "own_cell",
    },
)
