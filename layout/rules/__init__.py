"""Design rules and their markers."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.rules import check as check
    from layout.rules import foreign as foreign
    from layout.rules import markers as markers
    from layout.rules.report import DrcReport as DrcReport
    from layout.rules.report import Violation as Violation
    from layout.rules.report import told as told

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "DrcReport": "report",
        "Violation": "report",
        "check": "",
        "foreign": "",
        "markers": "",
        "told": "report",
    },
)
