"""A modal method for round pillars: exact along z, elements that follow the disc
across.

``solve`` gives one response with its error estimate.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.modal.case import case_of as case_of
    from metalens.modal.engine import solve as solve
    from metalens.modal.engine import solve_on_mesh as solve_on_mesh
    from metalens.modal.ladder import RUNGS as RUNGS
    from metalens.modal.ladder import MeshLevel as MeshLevel
    from metalens.modal.ladder import first_rung as first_rung

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "RUNGS": "ladder",
        "MeshLevel": "ladder",
        "case_of": "case",
        "solve_on_mesh": "engine",
        "first_rung": "ladder",
        "solve": "engine",
    },
)
