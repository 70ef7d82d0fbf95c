"""RUN_DIR... to one page: every table and figure of the paper with our measurement: paper, ours,
ratio, conditions.
"""

from dataclasses import dataclass
from pathlib import Path

import tyro

from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.paper"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens evaluate paper``.

    Attributes:
        runs: folders of finished runs: proposed, hyperbolic at mid-range, hyperbolic at
            best focus, double helix, as
            far as there are; without any, the claims are listed with the commands that
            measure them.
        output: folder for paper.json, report.html, and the measurements in optics,
            experiment and dim in it.
        subjects: of the experiment.
        scenes: of Table 1; imaged at the largest ``optics.image_tolerance`` of the
            runs.
        measure: measure what is not in the folder yet; without it only what is there is
            used.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]] = ()
    output: Output = Path("paper")
    subjects: int = 20
    scenes: int = 24
    measure: bool = True
