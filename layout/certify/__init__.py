"""What the written files make: exposure and etch simulated from files and dose table alone."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from layout.certify.certificate import Certificate as Certificate
    from layout.certify.certificate import certify as certify

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "Certificate": "certificate",
        "certify": "certificate",
    },
)
