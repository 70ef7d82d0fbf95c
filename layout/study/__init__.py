"""What the process spread does to the light."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from layout.study import page as page
    from layout.study.focus import check_study_lens as check_study_lens

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__, {"check_study_lens": "focus", "page": ""}
)
