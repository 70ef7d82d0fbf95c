"""Which tolerances, depths and wavelengths suffice for a gaze error, at the least cost:
settings files ready to run.

What is measured is kept beside the output (NAME.resume): after an interruption the same
command goes on.
"""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from codesign.evaluate import ExperimentConfig
from metalens.commands import Common, Output

WORK = "codesign.commands.plan"


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens plan``.

    Attributes:
        gaze_error: the goal, with its unit: 1deg, 50arcmin, 20mrad; of the whole error,
            from pillar to answered gaze.
        run: RUN_DIR of a co-design run: its reader is part of the floor; without one
            the floor is that of the person.
        frames: that the floor is measured on: subjects, stimuli, calibration, as those
            of the experiment.
        config: PLAN.toml of the lens and the run; left out: a 1 mm lens, 200 sets of
            PSFs, 10 000 true images.
        output: folder for cell.toml, psf.toml, run.toml, process.toml, plan.json and
            report.html.
    """

    gaze_error: str
    config: Path | None = None
    run: Path | None = None
    frames: tyro.conf.OmitArgPrefixes[ExperimentConfig] = field(
        default_factory=lambda: ExperimentConfig(subjects=5)
    )
    output: Output = Path("plan")
