"""Phases that are searched for (paper Eq. 6, 11)."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.design.free_form import report as report
    from metalens.design.free_form import simple_lenses as simple_lenses
    from metalens.design.free_form.objective import Score as Score
    from metalens.design.free_form.objective import score as score
    from metalens.design.free_form.search import design_pupil as design_pupil
    from metalens.design.free_form.search import fisher_profile as fisher_profile
    from metalens.design.free_form.settings import Asked as Asked
    from metalens.design.free_form.settings import Fisher as Fisher

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Asked": "settings",
        "Fisher": "settings",
        "Score": "objective",
        "design_pupil": "search",
        "fisher_profile": "search",
        "report": "",
        "score": "objective",
        "simple_lenses": "",
    },
)
