"""Units, errors, arrays, files, settings, output: what every room stands on."""

from typing import TYPE_CHECKING

from metalens.ground.lazy import attach

if TYPE_CHECKING:
    from metalens.ground import arrays as arrays
    from metalens.ground import config as config
    from metalens.ground import console as console
    from metalens.ground import errors as errors
    from metalens.ground import executor as executor
    from metalens.ground import lazy as lazy
    from metalens.ground import legendre as legendre
    from metalens.ground import lock as lock
    from metalens.ground import manifest as manifest
    from metalens.ground import paths as paths
    from metalens.ground import reading as reading
    from metalens.ground import report as report
    from metalens.ground import store as store
    from metalens.ground import threads as threads
    from metalens.ground import transaction as transaction
    from metalens.ground import units as units

__getattr__, __dir__, __all__ = attach(
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
