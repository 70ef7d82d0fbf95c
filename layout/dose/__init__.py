"""Proximity correction."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.dose import bodies as bodies
    from layout.dose import correct as correct
    from layout.dose import exposure as exposure
    from layout.dose import nodes as nodes
    from layout.dose import sampled as sampled
    from layout.dose.assign import Ladder as Ladder
    from layout.dose.assign import dose_ladder as dose_ladder
    from layout.dose.bodies import Body as Body
    from layout.dose.bodies import Rects as Rects
    from layout.dose.correct import DoseResult as DoseResult
    from layout.dose.correct import Solution as Solution
    from layout.dose.drawn import Discs as Discs
    from layout.dose.drawn import Drawn as Drawn
    from layout.dose.drawn import Outlines as Outlines
    from layout.dose.uniformity import Uniformity as Uniformity

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Body": "bodies",
        "Discs": "drawn",
        "DoseResult": "correct",
        "Drawn": "drawn",
        "Ladder": "assign",
        "Outlines": "drawn",
        "Rects": "bodies",
        "Solution": "correct",
        "Uniformity": "uniformity",
        "bodies": "",
        "correct": "",
        "dose_ladder": "assign",
        "exposure": "",
        "nodes": "",
        "sampled": "",
    },
)
