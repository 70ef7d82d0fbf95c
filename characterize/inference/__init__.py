"""Frames + model -> AsBuilt."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from characterize.inference import asbuilt as asbuilt
    from characterize.inference import knowable as knowable
    from characterize.inference import leastsquares as leastsquares
    from characterize.inference import missing as missing
    from characterize.inference import posterior as posterior
    from characterize.inference.asbuilt import AsBuilt as AsBuilt
    from characterize.inference.estimate import Options as Options
    from characterize.inference.estimate import fit as fit
    from characterize.inference.leastsquares import Data as Data
    from characterize.inference.leastsquares import Prior as Prior
    from characterize.inference.leastsquares import Settings as Settings
    from characterize.inference.leastsquares import Solution as Solution
    from characterize.inference.leastsquares import invert as invert
    from characterize.inference.missing import Unstated as Unstated
    from characterize.inference.search import Task as Task

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "AsBuilt": "asbuilt",
        "Data": "leastsquares",
        "Options": "estimate",
        "Prior": "leastsquares",
        "Settings": "leastsquares",
        "Solution": "leastsquares",
        "Task": "search",
        "Unstated": "missing",
        "asbuilt": "",
        "fit": "estimate",
        "invert": "leastsquares",
        "knowable": "",
        "leastsquares": "",
        "missing": "",
        "posterior": "",
    },
)
