"""Frames + model -> AsBuilt."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.inference import asbuilt as asbuilt
    from characterize.inference import knowable as knowable
    from characterize.inference import leastsquares as leastsquares
    from characterize.inference import missing as missing
    from characterize.inference import posterior as posterior
    from characterize.inference.asbuilt import AsBuilt as AsBuilt
    from characterize.inference.estimate import FitOptions as FitOptions
    from characterize.inference.estimate import fit as fit
    from characterize.inference.leastsquares import FitImages as FitImages
    from characterize.inference.leastsquares import FitSolution as FitSolution
    from characterize.inference.leastsquares import GaussianPrior as GaussianPrior
    from characterize.inference.leastsquares import SolverSettings as SolverSettings
    from characterize.inference.leastsquares import (
        invert_information as invert_information,
    )
    from characterize.inference.missing import UnmodelledShifts as UnmodelledShifts
    from characterize.inference.search import SearchTask as SearchTask

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "AsBuilt": "asbuilt",
        "FitImages": "leastsquares",
        "FitOptions": "estimate",
        "GaussianPrior": "leastsquares",
        "SolverSettings": "leastsquares",
        "FitSolution": "leastsquares",
        "SearchTask": "search",
        "UnmodelledShifts": "missing",
        "asbuilt": "",
        "fit": "estimate",
        "invert_information": "leastsquares",
        "knowable": "",
        "leastsquares": "",
        "missing": "",
        "posterior": "",
    },
)
