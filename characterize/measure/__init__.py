"""Image metrics, frame quality, micrographs."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from characterize.measure import frames as frames
    from characterize.measure import metrics as metrics
    from characterize.measure import overlay as overlay
    from characterize.measure import picture as picture
    from characterize.measure import sem as sem

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__, {"frames": "", "metrics": "", "overlay": "", "picture": "", "sem": ""}
)
