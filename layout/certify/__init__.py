"""What the written files make: exposure and etch simulated from files and dose table
alone.
"""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.certify.certificate import survey as survey
    from layout.certify.made_lens import MadeRows as MadeRows
    from layout.certify.verdict import Survey as Survey

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "MadeRows": "made_lens",
        "Survey": "verdict",
        "survey": "certificate",
    },
)
