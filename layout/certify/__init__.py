"""What the written files make: exposure and etch simulated from files and dose table alone."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.certify.certificate import Certificate as Certificate
    from layout.certify.certificate import Edges as Edges
    from layout.certify.certificate import certify as certify
    from layout.certify.made_lens import as_made as as_made

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Certificate": "certificate",
        "Edges": "certificate",
        "as_made": "made_lens",
        "certify": "certificate",
    },
)
