"""Inner loop, search, run, checkpoints."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.train import assess as assess
    from codesign.train import checkpoint as checkpoint
    from codesign.train import pictures as pictures
    from codesign.train import run as run
    from codesign.train import search as search
    from codesign.train.assess import Predictions as Predictions
    from codesign.train.assess import SensorFrames as SensorFrames
    from codesign.train.evolution import EvaluatedCandidate as EvaluatedCandidate
    from codesign.train.evolution import best_candidate as best_candidate
    from codesign.train.evolution import pareto_front as pareto_front
    from codesign.train.finish import BudgetResult as BudgetResult
    from codesign.train.finish import finished_budgets as finished_budgets
    from codesign.train.formation import frame_wide as frame_wide
    from codesign.train.formation import read_out as read_out
    from codesign.train.inner import FrameBatch as FrameBatch
    from codesign.train.inner import InnerConfig as InnerConfig
    from codesign.train.inner import LearningRateSchedule as LearningRateSchedule
    from codesign.train.inner import LogRecord as LogRecord
    from codesign.train.inner import SceneSource as SceneSource
    from codesign.train.inner import Trainer as Trainer
    from codesign.train.inner import make_model as make_model
    from codesign.train.placement import device_of as device_of
    from codesign.train.placement import place_on_device as place_on_device
    from codesign.train.run import CodesignRun as CodesignRun
    from codesign.train.run import RunConfig as RunConfig
    from codesign.train.words import Part as Part
    from codesign.train.words import Place as Place

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Predictions": "assess",
        "FrameBatch": "inner",
        "EvaluatedCandidate": "evolution",
        "BudgetResult": "finish",
        "InnerConfig": "inner",
        "Part": "words",
        "Place": "words",
        "LogRecord": "inner",
        "CodesignRun": "run",
        "RunConfig": "run",
        "SceneSource": "inner",
        "LearningRateSchedule": "inner",
        "SensorFrames": "assess",
        "Trainer": "inner",
        "assess": "",
        "best_candidate": "evolution",
        "checkpoint": "",
        "device_of": "placement",
        "finished_budgets": "finish",
        "make_model": "inner",
        "pareto_front": "evolution",
        "pictures": "",
        "place_on_device": "placement",
        "frame_wide": "formation",
        "read_out": "formation",
        "run": "",
        "search": "",
    },
)
