"""Optics, pixel pitch and network optimised together for an eye in front of the lens.

Names load when first used: ``import codesign; codesign.render(states)``.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from codesign.adapt.train import retrain as retrain
    from codesign.eye.renderer import render as render
    from codesign.network.cost import macs as macs
    from codesign.network.supernet import Supernet as Supernet
    from codesign.train.evolution import search as search

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "Supernet": "codesign.network.supernet",
        "macs": "codesign.network.cost",
        "render": "codesign.eye.renderer",
        "retrain": "codesign.adapt.train",
        "search": "codesign.train.evolution",
    },
)
