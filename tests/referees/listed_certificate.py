"""A mask certified place by place: every pillar is read from the file and kept, and no
plan is asked.

:func:`layout.certify.survey` takes places from the lattices of a plan in bands; here
they are a list of any file's.
"""

from types import SimpleNamespace

import numpy as np

from layout.certify.certificate import _fixed, _judged, _surveyed, _terms
from layout.certify.gathered import Exposed, _Found
from layout.files import flat
from metalens.ground.errors import ProcessError
from metalens.ground.units import nm

STRIP = 1 << 17  # pillars of a strip


class Listed:
    """Places in memory, sorted by strip of equal height from bottom to top."""

    def __init__(self, x_um, y_um, kind):
        self.box_um = (
            float(x_um.min()),
            float(y_um.min()),
            float(x_um.max()),
            float(y_um.max()),
        )
        self.count, self.strips = len(x_um), max(1, len(x_um) // STRIP)
        bottom, top = self.box_um[1::2]
        self.height_um = (top - bottom) / self.strips * (1 + 1e-12) or 1.0
        strip = np.minimum((y_um - bottom) / self.height_um, self.strips - 1).astype(
            int
        )
        order = np.argsort(strip, kind="stable")
        self.starts = np.searchsorted(strip[order], np.arange(self.strips + 1))
        self.columns = x_um[order], y_um[order], kind[order]

    def part(self, first, end):
        """(n,) x, y and kind of the pillars of some strips."""
        some = slice(
            int(self.starts[max(first, 0)]), int(self.starts[min(end, self.strips)])
        )
        return tuple(column[some] for column in self.columns)


def exposed(content, doses, fixed):
    """Everything below the top cells but the layer numbers ``fixed``."""
    found = _Found(content.unit_nm * nm, doses, fixed)
    for stack in (s for top in content.tops for s in flat.stacks(content, top)):
        found.take(stack)
    if not found.x:
        raise ProcessError(
            "the mask holds no round pillar with a dose; nothing can be certified"
        )
    kind = np.repeat(np.arange(len(found.x), dtype=np.int32), [len(x) for x in found.x])
    places = Listed(np.concatenate(found.x), np.concatenate(found.y), kind)
    return Exposed(found.kinds, places, found.others, tuple(sorted(found.missing)))


def certify(content, doses, process, *, height_um=0.0):
    """What comes out of a mask that was read back, with its dose table.

    Returns:
        survey, and (n,) arrays, a pillar each: x_um, y_um; drawn_nm (equal-area of the
        polygon), resist_nm, made_nm (at
        half height after the etch); exposure of the drawn edge, relative to
        dose-to-size; layer number; judged (not of
        the dose test, which is wrong on purpose).
    """
    terms, scene, bands = _terms(process), exposed(content, doses, _fixed(process)), []
    survey = _surveyed(scene, process, terms, height_um, bands.append)
    names = ("x_um", "y_um", "exposure", "resist_nm", "made_nm", "kind")
    found = SimpleNamespace(
        **{name: np.concatenate([getattr(b, name) for b in bands]) for name in names}
    )
    found.drawn_nm = (scene.kinds.size_um / nm).astype(np.float32)[found.kind]
    found.layer, found.judged = (
        scene.kinds.layer[found.kind],
        _judged(scene, process)[found.kind],
    )
    found.survey = survey
    return found
