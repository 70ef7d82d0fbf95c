"""Pillar libraries: a cell swept over size, wavelength and angle, and its proxy."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.library import axes as axes
    from metalens.library import converted as converted
    from metalens.library import curve as curve
    from metalens.library import engines as engines
    from metalens.library import fit as fit
    from metalens.library import rational as rational
    from metalens.library import record as record
    from metalens.library import study as study
    from metalens.library import study_plots as study_plots
    from metalens.library import workers as workers
    from metalens.library.fit import ProxyFit as ProxyFit
    from metalens.library.fit import ProxyTolerances as ProxyTolerances
    from metalens.library.fit import proxy_of as proxy_of
    from metalens.library.proxy import MOST_ERROR as MOST_ERROR
    from metalens.library.proxy import Proxy as Proxy
    from metalens.library.proxy import height_hint as height_hint
    from metalens.library.record import DEFAULT_CELL as DEFAULT_CELL
    from metalens.library.record import PillarLibrary as PillarLibrary
    from metalens.library.record import Sweep as Sweep
    from metalens.library.record import check_sweep as check_sweep
    from metalens.library.record import load as load
    from metalens.library.record import save as save
    from metalens.library.study import CellStudy as CellStudy
    from metalens.library.study_plots import library_figure as library_figure
    from metalens.library.sweeping import sweep as sweep
    from metalens.library.workers import SweepJournal as SweepJournal

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "CellStudy": "study",
        "DEFAULT_CELL": "record",
        "MOST_ERROR": "proxy",
        "PillarLibrary": "record",
        "Proxy": "proxy",
        "ProxyFit": "fit",
        "ProxyTolerances": "fit",
        "Sweep": "record",
        "SweepJournal": "workers",
        "axes": "",
        "check_sweep": "record",
        "converted": "",
        "curve": "",
        "engines": "",
        "fit": "",
        "height_hint": "proxy",
        "library_figure": "study_plots",
        "load": "record",
        "proxy_of": "fit",
        "rational": "",
        "record": "",
        "save": "record",
        "study": "",
        "study_plots": "",
        "sweep": "sweeping",
        "workers": "",
    },
)
