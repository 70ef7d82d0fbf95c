"""PSFs of an as-built file, for ``metalens psf``."""

from pathlib import Path

from characterize.inference import asbuilt
from metalens.lens import Lens
from metalens.psf import PsfStack, View


def design(path: Path) -> Lens:
    """The lens that was to be made."""
    return asbuilt.load(path).design


def stack(path: Path, view: View, tolerance: float) -> PsfStack:
    """PSFs (angle, depth, y, x) of the best estimate: pillars, process, wave front, distance and wavelength as fitted.

    Raises:
        StoreError: not an as-built file; PropagationError: as :func:`metalens.psf.psf_stack`.
    """
    return asbuilt.load(path).psf_stack(view, tolerance=tolerance)
