"""Bench captures to the as-built lens, with its uncertainty.

Names load when first used: ``import characterize; characterize.fit(capture, lens)``.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.captures.capture import Capture as Capture
    from characterize.captures.capture import load as load
    from characterize.inference.asbuilt import AsBuilt as AsBuilt
    from characterize.inference.estimate import fit as fit
    from characterize.pupil.fit import fit_pupil as fit_pupil
    from characterize.pupil.record import PupilSpec as PupilSpec

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "AsBuilt": "characterize.inference.asbuilt",
        "Capture": "characterize.captures.capture",
        "PupilSpec": "characterize.pupil.record",
        "fit": "characterize.inference.estimate",
        "fit_pupil": "characterize.pupil.fit",
        "load": "characterize.captures.capture",
    },
)
