"""Image metrics, frame quality, micrographs."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from characterize.measure import frames as frames
    from characterize.measure import metrics as metrics
    from characterize.measure import overlay as overlay
    from characterize.measure import picture as picture
    from characterize.measure import sem as sem

__getattr__, __dir__, __all__ = attach(
    __name__,
    {
        "frames": "",
        "metrics": "",
        "overlay": "",
        "picture": "",
        "sem": "",
    },
)
