"""Typed refusals. Each says what was found, what is needed, what to do, and where.

All derive from ``ValueError``, so a caller may catch one type; commands turn them into
exit code 2.
"""

import difflib
from collections.abc import Iterable

# what libraries raise on damaged files
DAMAGE = (
    OSError,
    KeyError,
    RuntimeError,
    ValueError,
    TypeError,
    OverflowError,
    MemoryError,
    AttributeError,
)


class MetalensError(ValueError):
    """Base of every refusal in the toolchain."""


class ConfigError(MetalensError):
    """A config file holds an unknown key, a wrong type or an impossible value."""


class StoreError(MetalensError):
    """An artefact file is missing, truncated, foreign, or of another kind or version."""


class OutputError(MetalensError):
    """An output cannot be written where it is asked for: taken, an input too, or
    being written by another.
    """


class WorkerError(MetalensError):
    """A worker process died."""


class MaterialError(MetalensError):
    """A material is unknown or asked for outside the range of its source."""


class CellError(MetalensError):
    """A pillar cell is impossible: pillars touch, or diffraction orders propagate."""


class DomainError(MetalensError):
    """A proxy or library is asked outside the domain on which its error is known."""


class LensError(MetalensError):
    """A diameter map or lens is invalid; the message names row and column."""


class PropagationError(MetalensError):
    """A propagation case cannot be computed as asked."""


class ProcessError(MetalensError):
    """A process file or a mask plan breaks the limits of the process or of the file
    format.
    """


class MaskFileError(MetalensError):
    """A mask file cannot be read; the message gives the byte offset."""


class CaptureError(MetalensError):
    """Bench captures are unreadable, inconsistent or incomplete."""


class FitError(MetalensError):
    """A fit cannot be done or is refused; the message names the cause."""


class FitRefused(FitError):
    """A fit was done and fails its own checks; commands turn it into exit code 1."""


class SceneError(MetalensError):
    """An eye, scene or sensor state cannot be rendered."""


class TrainingError(MetalensError):
    """A co-design run cannot start, resume or go on."""


def nearest_name_hint(name: str, known: Iterable[str]) -> str:
    """Hint for a misspelt name: ``; did you mean 'pitch_um'?`` or the list of known
    names.

    Args:
        name: that is unknown.
        known: names that are allowed.
    """
    options = sorted(known)
    close = difflib.get_close_matches(name, options, n=1, cutoff=0.5)
    return (
        f"; did you mean {close[0]!r}?" if close else f"; known: {', '.join(options)}"
    )


EXTRAS = {
    "torch": "optics",
    "colour": "optics",
    "astropy": "fits",
    "xarray": "xarray",
    "cv2": "bench",
    "tifffile": "bench",
    "safetensors": "codesign",
    "build123d": "cad",
    "OCP": "cad",
    "mitsuba": "referee",
}  # import name: extra


def missing_extra(missing: ModuleNotFoundError) -> str | None:
    """What to install for a missing optional library; None for any other.

    >>> missing_extra(ModuleNotFoundError("No module named 'torch'", name="torch"))
    "this needs torch, which is not installed: pip install 'metalens-toolchain[optics]'"
    >>> missing_extra(ModuleNotFoundError("No module named 'queue2'", name="queue2")) is None
    True
    """
    top = (missing.name or "").partition(".")[0]
    if top not in EXTRAS:
        return None
    return f"this needs {top}, which is not installed: pip install 'metalens-toolchain[{EXTRAS[top]}]'"
