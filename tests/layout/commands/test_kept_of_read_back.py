"""What a read-back keeps in memory: all places of small masks, sums alone of larger
ones.
"""

import contextlib
from types import SimpleNamespace

import numpy as np
import pytest

import layout
from layout.commands import make
from layout.formats import doses
from layout.process.process import Process
from metalens.lens.record import DiameterMap


@pytest.mark.parametrize(("rows", "kept"), [(256, True), (257, False)])
def test_a_cell_of_more_than_65536_places_is_read_back_as_sums(
    tmp_path, monkeypatch, rows, kept
):
    """2^16 places are 0.6 MB; a lens of 10 mm has 6e8. Either way every pillar is
    found.
    """
    process = Process()
    plan = layout.plan(
        DiameterMap(np.full((rows, 256), 0.2), 0.4), process, furnished=False
    )
    layout.write_gdsii(plan, tmp_path / "mask.gds")
    doses.write_dose_table(plan, process, tmp_path / "doses.csv")
    seen, compare = [], make.verify.compare
    monkeypatch.setattr(
        make.verify,
        "compare",
        lambda plan, content: seen.append(content) or compare(plan, content),
    )
    job = SimpleNamespace(
        plan=plan, process=process, compared={}, undosed={}, written={}
    )
    job.stages = lambda text: contextlib.nullcontext()
    job.source = SimpleNamespace(diameters=SimpleNamespace(plain=True))
    make._read_back(job, tmp_path / "mask.gds", layout.read_gdsii)
    (lens,) = (cell for cell in seen[0].cells.values() if cell.name == "LENS")
    assert (lens.sums is None) == kept
    assert len(lens.placed.x) == (rows * 256 if kept else 0)
    outcome = job.compared["mask.gds"]
    assert (outcome.pillars, outcome.ok) == (rows * 256, True)
