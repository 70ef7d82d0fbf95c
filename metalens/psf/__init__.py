"""Point spread functions of a lens over depth, field angle and wavelength (paper Sec.
3.1, Eqs. 1-3).

``psf_stack`` takes phase and transmission maps, ``from_lens`` a lens file's content;
``on_pixels`` gives what a sensor
sees; ``save`` and ``load`` keep a stack as a file.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.psf import among as among
    from metalens.psf import export as export
    from metalens.psf import plots as plots
    from metalens.psf import spectrum as spectrum
    from metalens.psf.budget import NEIGHBOURS as NEIGHBOURS
    from metalens.psf.budget import Budget as Budget
    from metalens.psf.budget import LeftOut as LeftOut
    from metalens.psf.budget import Polarisation as Polarisation
    from metalens.psf.budget import scalar_error as scalar_error
    from metalens.psf.budget import sine_aperture as sine_aperture
    from metalens.psf.directions import FarField as FarField
    from metalens.psf.directions import far_field as far_field
    from metalens.psf.extended import Extent as Extent
    from metalens.psf.focus import focus_metrics as focus_metrics
    from metalens.psf.metrics import DiffractionLimit as DiffractionLimit
    from metalens.psf.metrics import FocusMetrics as FocusMetrics
    from metalens.psf.metrics import blur_um as blur_um
    from metalens.psf.metrics import diffraction_limit as diffraction_limit
    from metalens.psf.metrics import encircled_power as encircled_power
    from metalens.psf.metrics import find_peak as find_peak
    from metalens.psf.metrics import fwhm as fwhm
    from metalens.psf.of_lens import View as View
    from metalens.psf.of_lens import all_maps as all_maps
    from metalens.psf.of_lens import from_lens as from_lens
    from metalens.psf.of_lens import library_incidence as library_incidence
    from metalens.psf.of_lens import mean_over_polarizations as mean_over_polarizations
    from metalens.psf.of_lens import passed_um2 as passed_um2
    from metalens.psf.pixels import integrate_pixels as integrate_pixels
    from metalens.psf.pixels import on_pixels as on_pixels
    from metalens.psf.pixels import pixel_count as pixel_count
    from metalens.psf.pixels import pixel_weights as pixel_weights
    from metalens.psf.pixels import whole_pixels as whole_pixels
    from metalens.psf.record import PsfStack as PsfStack
    from metalens.psf.record import SourceShape as SourceShape
    from metalens.psf.record import load as load
    from metalens.psf.record import save as save
    from metalens.psf.spectrum import Source as Source
    from metalens.psf.spectrum import SpectralNodes as SpectralNodes
    from metalens.psf.stack import psf_stack as psf_stack
    from metalens.psf.vector import VectorPupil as VectorPupil
    from metalens.psf.vector import beyond_faces as beyond_faces
    from metalens.psf.vector import dominant_components as dominant_components
    from metalens.psf.vector import of_flux as of_flux
    from metalens.psf.vector import transmitted_polarization as transmitted_polarization
    from metalens.psf.z_scan import FocusScan as FocusScan
    from metalens.psf.z_scan import focus_scan as focus_scan

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Budget": "budget",
        "DiffractionLimit": "metrics",
        "Extent": "extended",
        "FarField": "directions",
        "FocusMetrics": "metrics",
        "FocusScan": "z_scan",
        "LeftOut": "budget",
        "VectorPupil": "vector",
        "NEIGHBOURS": "budget",
        "SpectralNodes": "spectrum",
        "Polarisation": "budget",
        "PsfStack": "record",
        "Source": "spectrum",
        "SourceShape": "record",
        "View": "of_lens",
        "all_maps": "of_lens",
        "among": "",
        "sine_aperture": "budget",
        "beyond_faces": "vector",
        "blur_um": "metrics",
        "find_peak": "metrics",
        "diffraction_limit": "metrics",
        "encircled_power": "metrics",
        "export": "",
        "far_field": "directions",
        "focus_metrics": "focus",
        "focus_scan": "z_scan",
        "from_lens": "of_lens",
        "fwhm": "metrics",
        "library_incidence": "of_lens",
        "mean_over_polarizations": "of_lens",
        "load": "record",
        "of_flux": "vector",
        "on_pixels": "pixels",
        "integrate_pixels": "pixels",
        "pixel_count": "pixels",
        "pixel_weights": "pixels",
        "whole_pixels": "pixels",
        "passed_um2": "of_lens",
        "plots": "",
        "psf_stack": "stack",
        "save": "record",
        "scalar_error": "budget",
        "spectrum": "",
        "dominant_components": "vector",
        "transmitted_polarization": "vector",
    },
)
