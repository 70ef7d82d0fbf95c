"""Exposure and etch of the written files, by files and dose table alone."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.certify.as_written import LensRows as LensRows
    from layout.certify.verdict import Survey as Survey
    from layout.certify.verify import Rows as Rows
    from layout.certify.verify import survey as survey

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "LensRows": "as_written",
        "Rows": "verify",
        "Survey": "verdict",
        "survey": "verify",
    },
)
