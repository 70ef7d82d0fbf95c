"""What each link of the chain costs in gaze."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.budget import links as links
    from codesign.budget import page as page
    from codesign.budget.entry import MEASURED as MEASURED
    from codesign.budget.entry import TOTAL as TOTAL
    from codesign.budget.entry import BudgetEntry as BudgetEntry
    from codesign.budget.entry import quadrature_total as quadrature_total
    from codesign.budget.prepared import BudgetInputs as BudgetInputs
    from codesign.budget.prepared import prepare_device as prepare_device

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "BudgetEntry": "entry",
        "BudgetInputs": "prepared",
        "MEASURED": "entry",
        "TOTAL": "entry",
        "prepare_device": "prepared",
        "links": "",
        "page": "",
        "quadrature_total": "entry",
    },
)
