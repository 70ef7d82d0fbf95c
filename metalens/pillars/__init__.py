"""From solves to t(D): sweep, rational curve, library, proxy and its inverse."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.pillars import axes as axes
    from metalens.pillars import converted as converted
    from metalens.pillars import curve as curve
    from metalens.pillars import engines as engines
    from metalens.pillars import fit as fit
    from metalens.pillars import rational as rational
    from metalens.pillars import record as record
    from metalens.pillars import study as study
    from metalens.pillars import study_plots as study_plots
    from metalens.pillars import workers as workers
    from metalens.pillars.fit import ProxyFit as ProxyFit
    from metalens.pillars.fit import ProxyTolerances as ProxyTolerances
    from metalens.pillars.proxy import MOST_ERROR as MOST_ERROR
    from metalens.pillars.proxy import Proxy as Proxy
    from metalens.pillars.proxy import height_hint as height_hint
    from metalens.pillars.record import DEFAULT_CELL as DEFAULT_CELL
    from metalens.pillars.record import PillarLibrary as PillarLibrary
    from metalens.pillars.record import Sweep as Sweep
    from metalens.pillars.study import CellStudy as CellStudy
    from metalens.pillars.study_plots import library_figure as library_figure
    from metalens.pillars.workers import SweepJournal as SweepJournal

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "study_plots": "",
        "DEFAULT_CELL": "record",
        "SweepJournal": "workers",
        "MOST_ERROR": "proxy",
        "PillarLibrary": "record",
        "Proxy": "proxy",
        "ProxyFit": "fit",
        "CellStudy": "study",
        "Sweep": "record",
        "ProxyTolerances": "fit",
        "axes": "",
        "converted": "",
        "curve": "",
        "engines": "",
        "fit": "",
        "library_figure": "study_plots",
        "rational": "",
        "record": "",
        "study": "",
        "height_hint": "proxy",
        "workers": "",
    },
)
