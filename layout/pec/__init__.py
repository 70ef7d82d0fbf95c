"""Proximity correction."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.pec import bodies as bodies
    from layout.pec import correct as correct
    from layout.pec import nodes as nodes
    from layout.pec import psf as psf
    from layout.pec import sampled as sampled
    from layout.pec.assign import DoseLadder as DoseLadder
    from layout.pec.assign import dose_ladder as dose_ladder
    from layout.pec.bodies import PillarArray as PillarArray
    from layout.pec.bodies import Rects as Rects
    from layout.pec.correct import DoseResult as DoseResult
    from layout.pec.correct import Solution as Solution
    from layout.pec.drawn import Discs as Discs
    from layout.pec.drawn import Drawn as Drawn
    from layout.pec.drawn import Outlines as Outlines
    from layout.pec.uniformity import Uniformity as Uniformity

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "PillarArray": "bodies",
        "Discs": "drawn",
        "DoseResult": "correct",
        "Drawn": "drawn",
        "DoseLadder": "assign",
        "Outlines": "drawn",
        "Rects": "bodies",
        "Solution": "correct",
        "Uniformity": "uniformity",
        "bodies": "",
        "correct": "",
        "dose_ladder": "assign",
        "psf": "",
        "nodes": "",
        "sampled": "",
    },
)
