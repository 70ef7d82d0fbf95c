"""What each link costs in gaze; the planner."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.budget import floor as floor
    from codesign.budget import links as links
    from codesign.budget import page as page
    from codesign.budget import plan as plan
    from codesign.budget.chain import Chain as Chain
    from codesign.budget.chain import PlanConfig as PlanConfig
    from codesign.budget.entry import MEASURED as MEASURED
    from codesign.budget.entry import TOTAL as TOTAL
    from codesign.budget.entry import Entry as Entry
    from codesign.budget.entry import total as total
    from codesign.budget.journal import Journal as Journal
    from codesign.budget.plan import Pilot as Pilot
    from codesign.budget.plan import Plan as Plan
    from codesign.budget.prepared import Given as Given
    from codesign.budget.prepared import bench as bench
    from codesign.budget.prepared import same_geometry as same_geometry

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Chain": "chain",
        "Entry": "entry",
        "Given": "prepared",
        "Journal": "journal",
        "MEASURED": "entry",
        "Pilot": "plan",
        "Plan": "plan",
        "PlanConfig": "chain",
        "TOTAL": "entry",
        "bench": "prepared",
        "floor": "",
        "links": "",
        "page": "",
        "plan": "",
        "same_geometry": "prepared",
        "total": "entry",
    },
)
