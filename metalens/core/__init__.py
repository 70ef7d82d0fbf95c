"""Units, errors, arrays, files, settings, output: what every room stands on."""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

if TYPE_CHECKING:
    from metalens.core import arrays as arrays
    from metalens.core import config as config
    from metalens.core import console as console
    from metalens.core import errors as errors
    from metalens.core import executor as executor
    from metalens.core import lazy as lazy
    from metalens.core import legendre as legendre
    from metalens.core import lock as lock
    from metalens.core import manifest as manifest
    from metalens.core import paths as paths
    from metalens.core import reading as reading
    from metalens.core import report as report
    from metalens.core import store as store
    from metalens.core import threads as threads
    from metalens.core import transaction as transaction
    from metalens.core import units as units

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "lazy": "",
        "arrays": "",
        "config": "",
        "console": "",
        "errors": "",
        "executor": "",
        "legendre": "",
        "lock": "",
        "manifest": "",
        "reading": "",
        "paths": "",
        "report": "",
        "store": "",
        "threads": "",
        "transaction": "",
        "units": "",
    },
)
