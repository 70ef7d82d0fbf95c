"""Exposure and etch of the written files, by files and dose table alone."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.verify.as_written import LensRows as LensRows
    from layout.verify.exposure import ExposedRows as ExposedRows
    from layout.verify.exposure import verify_exposure as verify_exposure
    from layout.verify.report import ExposureReport as ExposureReport

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "LensRows": "as_written",
        "ExposedRows": "exposure",
        "ExposureReport": "report",
        "verify_exposure": "exposure",
    },
)
