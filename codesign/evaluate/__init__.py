"""The paper's tables and figures."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.evaluate import experiment_plots as experiment_plots
    from codesign.evaluate import field_page as field_page
    from codesign.evaluate import gaze_experiment as gaze_experiment
    from codesign.evaluate import imaged as imaged
    from codesign.evaluate import optics as optics
    from codesign.evaluate import paper as paper
    from codesign.evaluate import paper_runs as paper_runs
    from codesign.evaluate import plots as plots
    from codesign.evaluate import reader as reader
    from codesign.evaluate import tables as tables
    from codesign.evaluate.field_page import FieldSetting as FieldSetting
    from codesign.evaluate.gaze_experiment import AXIAL as AXIAL
    from codesign.evaluate.gaze_experiment import LATERAL as LATERAL
    from codesign.evaluate.gaze_experiment import RunResult as RunResult
    from codesign.evaluate.gaze_experiment import run_experiment as run_experiment
    from codesign.evaluate.optics import MeasurementSettings as MeasurementSettings
    from codesign.evaluate.optics import SensitivityScenes as SensitivityScenes
    from codesign.evaluate.paper import ROLES as ROLES
    from codesign.evaluate.paper import ClaimLine as ClaimLine
    from codesign.evaluate.paper import MeasuredNumber as MeasuredNumber
    from codesign.evaluate.reader import ReaderConfig as ReaderConfig
    from codesign.evaluate.reader import judge_lenses as judge_lenses
    from codesign.evaluate.shown import ExperimentConfig as ExperimentConfig

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "AXIAL": "gaze_experiment",
        "ExperimentConfig": "shown",
        "LATERAL": "gaze_experiment",
        "ClaimLine": "paper",
        "MeasuredNumber": "paper",
        "ROLES": "paper",
        "ReaderConfig": "reader",
        "RunResult": "gaze_experiment",
        "SensitivityScenes": "optics",
        "MeasurementSettings": "optics",
        "run_experiment": "gaze_experiment",
        "FieldSetting": "field_page",
        "experiment_plots": "",
        "field_page": "",
        "gaze_experiment": "",
        "judge_lenses": "reader",
        "imaged": "",
        "optics": "",
        "paper": "",
        "paper_runs": "",
        "plots": "",
        "reader": "",
        "tables": "",
    },
)
