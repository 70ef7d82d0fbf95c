"""lens.h5 -> error budget: every link of the chain as phase, PSF and gaze error, each
and how it was determined.
"""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from codesign.settings import ExperimentConfig
from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.budget"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens budget``.

    Attributes:
        lens: lens.h5.
        output: budget.h5 to write; with a report as .html.
        library: library.h5 that the lens was made from: parts solver and proxy.
        process: PROCESS.toml: adds mask grid and process spread.
        asbuilt: asbuilt.h5 of the same lens: adds the calibration uncertainty.
        run: RUN_DIR of a co-design run: its network reads the frames of the virtual
            experiment, and the sum is held
            against the error measured on them.
        frames: subjects, stimuli, slippage states, calibration: those of the
            experiment.
        led_fwhm_nm: width of the diode; 0 for that of the run.
    """

    lens: tyro.conf.Positional[Path]
    output: Output = Path("budget.h5")
    library: Path | None = None
    process: Path | None = None
    asbuilt: Path | None = None
    run: Path | None = None
    frames: tyro.conf.OmitArgPrefixes[ExperimentConfig] = field(
        default_factory=lambda: ExperimentConfig(subjects=5)
    )
    led_fwhm_nm: float = 0.0
