"""RUN_DIR... to Figs. 10 and 11: gaze and slippage of synthetic subjects before each
run's lens and network (Sec. 5).
"""

from dataclasses import dataclass, field
from pathlib import Path

import tyro

from codesign.settings import ExperimentConfig
from metalens.commands import CommonOptions, Output

WORK = "codesign.commands.experiment"


@dataclass(frozen=True)
class Options(CommonOptions):
    """Options of ``metalens evaluate experiment``.

    Attributes:
        runs: folders of finished runs of one geometry; the first is compared with each
            of the others. A folder of
            metalens retrain shows its network before the lens as made;
            nominal.safetensors in it, the unwarned one.
        output: folder for experiment.json, ambiguity.png, errors.png, report.html and,
            of every run that predicts the optic axis, people_1.h5 ...: what calibrates a wearer of that
            device (codesign.gaze.shared).
        names: of the runs; by default their folders'.
        frames: folder of own eye frames on the run's sensor, and frames.csv with a row for each: file; as far as
            known subject, mask (an image), pupil_x_px and pupil_y_px, slip_x_mm to slip_z_mm (stage), gaze_x_deg and
            gaze_y_deg. They are predicted in place of synthetic subjects, and compared with these targets: NAME.csv.
        settings: subjects, stimuli, slippage states, calibration.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    output: Output = Path("experiment")
    names: tuple[str, ...] = ()
    frames: Path | None = None
    settings: tyro.conf.OmitArgPrefixes[ExperimentConfig] = field(
        default_factory=ExperimentConfig
    )
