"""Any pupil from a through-focus stack."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.pupil.fit import PupilFit as PupilFit
    from characterize.pupil.fit import fit_pupil as fit_pupil
    from characterize.pupil.fit import save as save
    from characterize.pupil.record import PupilSpec as PupilSpec

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {"PupilFit": "fit", "PupilSpec": "record", "fit_pupil": "fit", "save": "fit"},
)
