"""Phases that are searched for (paper Eq. 6, 11)."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.design.free_form import report as report
    from metalens.design.free_form import simple_lenses as simple_lenses
    from metalens.design.free_form.objective import DesignScore as DesignScore
    from metalens.design.free_form.objective import score_phase as score_phase
    from metalens.design.free_form.search import design_pupil as design_pupil
    from metalens.design.free_form.search import fisher_profile as fisher_profile
    from metalens.design.free_form.settings import FisherSettings as FisherSettings
    from metalens.design.free_form.settings import (
        ResolvedFisherSettings as ResolvedFisherSettings,
    )

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "ResolvedFisherSettings": "settings",
        "FisherSettings": "settings",
        "DesignScore": "objective",
        "design_pupil": "search",
        "fisher_profile": "search",
        "report": "",
        "score_phase": "objective",
        "simple_lenses": "",
    },
)
