"""What each link of the chain costs in gaze."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.budget import links as links
    from codesign.budget import page as page
    from codesign.budget.entry import MEASURED as MEASURED
    from codesign.budget.entry import TOTAL as TOTAL
    from codesign.budget.entry import Entry as Entry
    from codesign.budget.entry import total as total
    from codesign.budget.prepared import Given as Given
    from codesign.budget.prepared import bench as bench

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Entry": "entry",
        "Given": "prepared",
        "MEASURED": "entry",
        "TOTAL": "entry",
        "bench": "prepared",
        "links": "",
        "page": "",
        "total": "entry",
    },
)
