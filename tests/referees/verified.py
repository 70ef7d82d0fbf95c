"""A written mask verified, with what comes out of every pillar as flat arrays."""

from types import SimpleNamespace

import numpy as np

from layout.verify.exposure import verify_exposure
from metalens.core.units import nm


def verify(plan, content, doses, process):
    """The report on a mask that was read back, and (n,) arrays, a pillar each: x_um,
    y_um; drawn_nm, resist_nm, made_nm; exposure of the drawn edge, relative to dose to
    size; layer number; judged (not of the dose test, which is wrong on purpose).
    """
    names = ("x_um", "y_um", "exposure", "resist_nm", "made_nm", "drawn_nm", "layer")
    found = {name: [] for name in names}

    def keep(rows):
        lattice, unit = plan.lattices[rows.number], plan.unit_nm * nm
        row, column = np.nonzero(rows.classes)
        kinds = [plan.classes[k - 1] for k in rows.classes[row, column].tolist()]
        down = lattice.row_pitch or lattice.pitch
        found["x_um"].append((lattice.x0 + column * lattice.pitch) * unit)
        found["y_um"].append((lattice.y0 - (rows.first + row) * down) * unit)
        for name in ("exposure", "resist_nm", "made_nm"):
            found[name].append(getattr(rows, name)[row, column])
        drawn = [
            2 * np.sqrt(k.twice_area / 2 / np.pi) if k.round else k.diameter_nm
            for k in kinds
        ]
        found["drawn_nm"].append(np.array(drawn))
        found["layer"].append(np.array([k.layer[0] for k in kinds]))

    result = verify_exposure(content, plan, doses, process, keep=keep)
    out = SimpleNamespace(**{n: np.concatenate(found[n]) for n in names})
    out.judged = out.layer != process.layers.dose[0]
    out.report = result
    return out
