"""The budget's entry of what a process draws, of any lens: nothing of its bench but the
aperture is asked.
"""

from types import SimpleNamespace

from codesign.budget import links
from codesign.budget.entry import BudgetEntry
from codesign.budget.prepared import BudgetInputs
from codesign.optics import TabulatedLens
from metalens.fabrication import Printed


def process_entry(lens, spread, draws):
    """The one entry of a mask of this spread."""
    about = SimpleNamespace(
        aperture=TabulatedLens(lens), lens=lens, given=BudgetInputs(mask=Printed(spread=spread), draws=draws),
        device=SimpleNamespace(image=lambda **moved: None), gathered=lambda phase, level: None,
        entry=lambda link, optics, method, phase_rad: BudgetEntry(link, phase_rad, 0.0, 0.0, method),
    )  # fmt: skip
    (entry,) = links.process_entries(about)
    return entry
