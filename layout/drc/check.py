"""Design-rule check of a plan or of a mask file."""

from pathlib import Path

from layout.drc.lattice import check_plan
from layout.drc.library import check_library
from layout.drc.report import DrcReport
from layout.formats.library import MaskLibrary
from layout.formats.reading import read_mask
from layout.mask.plan import MaskPlan
from layout.process.process import DesignRules


def check(mask: MaskPlan | MaskLibrary | str | Path, rules: DesignRules) -> DrcReport:
    """Check the design rules of a mask.

    Args:
        mask: plan of a lens (pairs of classes on its lattices), cells, or a GDSII or
            OASIS file (hierarchical sweep, all layers).
        rules: limits.

    Raises:
        MaskFileError: a file that cannot be read.
        ProcessError: a plan of too many outlines.
    """
    if isinstance(mask, MaskPlan):
        return check_plan(mask, rules)
    library = mask if isinstance(mask, MaskLibrary) else read_mask(Path(mask))
    return check_library(library, rules)
