"""Inner loop, search, run, checkpoints."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.train import assess as assess
    from codesign.train import checkpoint as checkpoint
    from codesign.train import pictures as pictures
    from codesign.train import run as run
    from codesign.train import search as search
    from codesign.train.assess import Answers as Answers
    from codesign.train.assess import Seen as Seen
    from codesign.train.evolution import Candidate as Candidate
    from codesign.train.evolution import best as best
    from codesign.train.evolution import pareto as pareto
    from codesign.train.finish import End as End
    from codesign.train.finish import finished as finished
    from codesign.train.formation import frame_wide as frame_wide
    from codesign.train.formation import read_out as read_out
    from codesign.train.inner import Batch as Batch
    from codesign.train.inner import InnerConfig as InnerConfig
    from codesign.train.inner import Record as Record
    from codesign.train.inner import Scenes as Scenes
    from codesign.train.inner import Schedule as Schedule
    from codesign.train.inner import Trainer as Trainer
    from codesign.train.inner import model as model
    from codesign.train.placement import device_of as device_of
    from codesign.train.placement import place as place
    from codesign.train.run import Run as Run
    from codesign.train.run import RunConfig as RunConfig
    from codesign.train.words import Part as Part
    from codesign.train.words import Place as Place

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Answers": "assess",
        "Batch": "inner",
        "Candidate": "evolution",
        "End": "finish",
        "InnerConfig": "inner",
        "Part": "words",
        "Place": "words",
        "Record": "inner",
        "Run": "run",
        "RunConfig": "run",
        "Scenes": "inner",
        "Schedule": "inner",
        "Seen": "assess",
        "Trainer": "inner",
        "assess": "",
        "best": "evolution",
        "checkpoint": "",
        "device_of": "placement",
        "finished": "finish",
        "model": "inner",
        "pareto": "evolution",
        "pictures": "",
        "place": "placement",
        "frame_wide": "formation",
        "read_out": "formation",
        "run": "",
        "search": "",
    },
)
