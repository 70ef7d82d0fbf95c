"""The paper's tables and figures."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

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
    from codesign.evaluate.gaze_experiment import Result as Result
    from codesign.evaluate.gaze_experiment import experiment as experiment
    from codesign.evaluate.optics import Scenes as Scenes
    from codesign.evaluate.optics import Setting as Setting
    from codesign.evaluate.paper import ROLES as ROLES
    from codesign.evaluate.paper import Line as Line
    from codesign.evaluate.paper import Measured as Measured
    from codesign.evaluate.reader import ReaderConfig as ReaderConfig
    from codesign.evaluate.reader import judged as judged
    from codesign.evaluate.shown import ExperimentConfig as ExperimentConfig

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "AXIAL": "gaze_experiment",
        "ExperimentConfig": "shown",
        "LATERAL": "gaze_experiment",
        "Line": "paper",
        "Measured": "paper",
        "ROLES": "paper",
        "ReaderConfig": "reader",
        "Result": "gaze_experiment",
        "Scenes": "optics",
        "Setting": "optics",
        "experiment": "gaze_experiment",
        "FieldSetting": "field_page",
        "experiment_plots": "",
        "field_page": "",
        "gaze_experiment": "",
        "judged": "reader",
        "imaged": "",
        "optics": "",
        "paper": "",
        "paper_runs": "",
        "plots": "",
        "reader": "",
        "tables": "",
    },
)
