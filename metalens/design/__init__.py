"""A wanted phase made of pillars, and the check that it focuses."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

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
    from metalens.design.of_phase import cure as cure
    from metalens.design.of_phase import field_angle as field_angle
    from metalens.design.of_phase import make as make
    from metalens.design.of_phase import phase_of as phase_of
    from metalens.design.own_cell import Unlike as Unlike
    from metalens.design.own_cell import left_out as left_out
    from metalens.design.own_cell import power_error as power_error
    from metalens.design.own_cell import rough_unlike as rough_unlike
    from metalens.design.own_cell import rows as rows
    from metalens.design.own_cell import unlike as unlike
    from metalens.design.paired import Split as Split
    from metalens.design.paired import make_paired as make_paired
    from metalens.design.profiles import Cubic as Cubic
    from metalens.design.profiles import DoubleHelix as DoubleHelix
    from metalens.design.profiles import Focus as Focus
    from metalens.design.profiles import PhaseMap as PhaseMap
    from metalens.design.profiles import hyperbolic as hyperbolic
    from metalens.design.several import Wanted as Wanted
    from metalens.design.several import make_several as make_several
    from metalens.design.sites import PhaseOf as PhaseOf
    from metalens.design.turned import Conversion as Conversion
    from metalens.design.turned import make_turned as make_turned

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Conversion": "turned",
        "Cubic": "profiles",
        "DoubleHelix": "profiles",
        "Focus": "profiles",
        "FocusCheck": "focus_check",
        "Limits": "of_phase",
        "PhaseMap": "profiles",
        "PhaseOf": "sites",
        "Quality": "of_phase",
        "Split": "paired",
        "Unlike": "own_cell",
        "Wanted": "several",
        "check_focus": "focus_check",
        "cure": "of_phase",
        "field_angle": "of_phase",
        "focus_figures": "focus_check",
        "focused": "focusing",
        "focuses": "focusing",
        "lens_meeting_um": "focusing",
        "meeting_um": "focusing",
        "hyperbolic": "profiles",
        "left_out": "own_cell",
        "make": "of_phase",
        "make_paired": "paired",
        "make_several": "several",
        "make_turned": "turned",
        "neighbours": "",
        "phase_of": "of_phase",
        "profiles": "",
        "power_error": "own_cell",
        "rough_unlike": "own_cell",
        "rows": "own_cell",
        "unlike": "own_cell",
    },
)
