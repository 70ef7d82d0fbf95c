"""A modal method for round pillars: exact along z, elements that follow the disc
across.

``solve`` gives one response with its error estimate.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.modal.case import case_of as case_of
    from metalens.modal.engine import evaluate as evaluate
    from metalens.modal.engine import solve as solve
    from metalens.modal.ladder import RUNGS as RUNGS
    from metalens.modal.ladder import Rung as Rung
    from metalens.modal.ladder import first_rung as first_rung

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "RUNGS": "ladder",
        "Rung": "ladder",
        "case_of": "case",
        "evaluate": "engine",
        "first_rung": "ladder",
        "solve": "engine",
    },
)
