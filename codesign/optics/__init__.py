"""The lens that training moves; as made; with all numbers of the chain open."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from codesign.optics import built as built
    from codesign.optics import formed as formed
    from codesign.optics import stack as stack
    from codesign.optics.built import MadeLens as MadeLens
    from codesign.optics.built import posterior as posterior
    from codesign.optics.built import psf_error as psf_error
    from codesign.optics.lens_errors import LensError as LensError
    from codesign.optics.lens_errors import LensErrors as LensErrors
    from codesign.optics.numerics import Aperture as Aperture
    from codesign.optics.numerics import Numerics as Numerics
    from codesign.optics.numerics import Window as Window
    from codesign.optics.numerics import kernels as kernels
    from codesign.optics.numerics import psf_difference as psf_difference
    from codesign.optics.stack import OpticsConfig as OpticsConfig
    from codesign.optics.stack import Stack as Stack
    from codesign.optics.true_lens import Device as Device
    from codesign.optics.true_lens import PillarCells as PillarCells
    from codesign.optics.true_lens import device as device
    from codesign.optics.true_lens import gathered as gathered
    from codesign.optics.true_lens import image_difference as image_difference

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Aperture": "numerics",
        "Device": "true_lens",
        "LensError": "lens_errors",
        "LensErrors": "lens_errors",
        "MadeLens": "built",
        "Numerics": "numerics",
        "OpticsConfig": "stack",
        "PillarCells": "true_lens",
        "Stack": "stack",
        "Window": "numerics",
        "built": "",
        "device": "true_lens",
        "formed": "",
        "gathered": "true_lens",
        "image_difference": "true_lens",
        "kernels": "numerics",
        "posterior": "built",
        "psf_difference": "numerics",
        "psf_error": "built",
        "stack": "",
    },
)
