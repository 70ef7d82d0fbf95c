"""Design-rule checks of masks, their report and their files for KLayout."""

from layout.drc.klayout import write_lyp as write_lyp
from layout.drc.klayout import write_lyrdb as write_lyrdb
from layout.drc.lattice import check_plan as check_plan
from layout.drc.library import LayerChoice as LayerChoice
from layout.drc.library import Metric as Metric
from layout.drc.library import check_library as check_library
from layout.drc.report import DrcReport as DrcReport
from layout.drc.report import Violation as Violation
from layout.drc.report import format_size as format_size

__all__ = [
    "DrcReport",
    "LayerChoice",
    "Metric",
    "Violation",
    "check_library",
    "check_plan",
    "format_size",
    "write_lyp",
    "write_lyrdb",
]
