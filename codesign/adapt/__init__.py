"""The network for the lens as made; the next mask."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.adapt import correction as correction
    from codesign.adapt import report as report
    from codesign.adapt import retrained as retrained
    from codesign.adapt import sure as sure
    from codesign.adapt import train as train
    from codesign.adapt.reading import bootstrap_interval as bootstrap_interval
    from codesign.adapt.settings import RetrainConfig as RetrainConfig
    from codesign.adapt.source import FinishedRun as FinishedRun
    from codesign.adapt.source import lens_file as lens_file
    from codesign.adapt.source import restore_weights as restore_weights
    from codesign.adapt.source import weights_file as weights_file
    from codesign.adapt.train import LensPsfs as LensPsfs

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "LensPsfs": "train",
        "RetrainConfig": "settings",
        "FinishedRun": "source",
        "bootstrap_interval": "reading",
        "correction": "",
        "lens_file": "source",
        "report": "",
        "restore_weights": "source",
        "retrained": "",
        "sure": "",
        "train": "",
        "weights_file": "source",
    },
)
