"""The lens that training moves; as made; with all numbers of the chain open."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.optics import built as built
    from codesign.optics import formed as formed
    from codesign.optics import stack as stack
    from codesign.optics.built import MadeLens as MadeLens
    from codesign.optics.built import posterior_parameters as posterior_parameters
    from codesign.optics.built import psf_error as psf_error
    from codesign.optics.lens_errors import LensError as LensError
    from codesign.optics.lens_errors import LensErrors as LensErrors
    from codesign.optics.numerics import ImageWindow as ImageWindow
    from codesign.optics.numerics import OpticsNumerics as OpticsNumerics
    from codesign.optics.numerics import TabulatedLens as TabulatedLens
    from codesign.optics.numerics import pixel_kernels as pixel_kernels
    from codesign.optics.numerics import psf_difference as psf_difference
    from codesign.optics.stack import OpticsConfig as OpticsConfig
    from codesign.optics.stack import PixelPsfStack as PixelPsfStack
    from codesign.optics.true_lens import ImagingDevice as ImagingDevice
    from codesign.optics.true_lens import PillarCells as PillarCells
    from codesign.optics.true_lens import gather_lens_plane as gather_lens_plane
    from codesign.optics.true_lens import image_difference as image_difference
    from codesign.optics.true_lens import make_device as make_device

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "TabulatedLens": "numerics",
        "ImagingDevice": "true_lens",
        "LensError": "lens_errors",
        "LensErrors": "lens_errors",
        "MadeLens": "built",
        "OpticsNumerics": "numerics",
        "OpticsConfig": "stack",
        "PillarCells": "true_lens",
        "PixelPsfStack": "stack",
        "ImageWindow": "numerics",
        "built": "",
        "make_device": "true_lens",
        "formed": "",
        "gather_lens_plane": "true_lens",
        "image_difference": "true_lens",
        "pixel_kernels": "numerics",
        "posterior_parameters": "built",
        "psf_difference": "numerics",
        "psf_error": "built",
        "stack": "",
    },
)
