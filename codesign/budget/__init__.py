"""What each link costs in gaze; the planner."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.budget import links as links
    from codesign.budget import page as page
    from codesign.budget import plan as plan
    from codesign.budget.journal import Journal as Journal
    from codesign.budget.links import Entry as Entry
    from codesign.budget.links import Given as Given
    from codesign.budget.plan import Chain as Chain
    from codesign.budget.plan import Pilot as Pilot
    from codesign.budget.plan import Plan as Plan
    from codesign.budget.plan import PlanConfig as PlanConfig

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Chain": "plan",
        "Entry": "links",
        "Given": "links",
        "Journal": "journal",
        "Pilot": "plan",
        "Plan": "plan",
        "PlanConfig": "plan",
        "links": "",
        "page": "",
        "plan": "",
    },
)
