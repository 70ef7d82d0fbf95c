"""Options of the verbs of co-design, apart from their work: what ``--help`` shows needs
neither torch nor time.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.commands.options import budget as budget
    from codesign.commands.options import codesign as codesign
    from codesign.commands.options import experiment as experiment
    from codesign.commands.options import optics as optics
    from codesign.commands.options import paper as paper
    from codesign.commands.options import retrain as retrain
    from codesign.commands.options import scene as scene

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "budget": "",
        "codesign": "",
        "experiment": "",
        "optics": "",
        "paper": "",
        "retrain": "",
        "scene": "",
    },
)
