"""Proximity correction."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.pec import bodies as bodies
    from layout.pec import correct as correct
    from layout.pec import nodes as nodes
    from layout.pec import psf as psf
    from layout.pec import sampled as sampled
    from layout.pec.assign import DoseLadder as DoseLadder
    from layout.pec.assign import dose_ladder as dose_ladder
    from layout.pec.bodies import ExposedRectangles as ExposedRectangles
    from layout.pec.bodies import PillarArray as PillarArray
    from layout.pec.correct import DoseResult as DoseResult
    from layout.pec.correct import DoseSolution as DoseSolution
    from layout.pec.drawn import DrawnDiscs as DrawnDiscs
    from layout.pec.drawn import DrawnKinds as DrawnKinds
    from layout.pec.drawn import DrawnOutlines as DrawnOutlines
    from layout.pec.uniformity import DoseUniformity as DoseUniformity

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "PillarArray": "bodies",
        "DrawnDiscs": "drawn",
        "DoseResult": "correct",
        "DrawnKinds": "drawn",
        "DoseLadder": "assign",
        "DrawnOutlines": "drawn",
        "ExposedRectangles": "bodies",
        "DoseSolution": "correct",
        "DoseUniformity": "uniformity",
        "bodies": "",
        "correct": "",
        "dose_ladder": "assign",
        "psf": "",
        "nodes": "",
        "sampled": "",
    },
)
