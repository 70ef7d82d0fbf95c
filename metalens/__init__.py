"""Optics core: pillar library, proxy, lenses, wave propagation, PSF stacks, image
formation, information.

Submodules load when first used: ``import metalens; metalens.psf.psf_stack(...)``.
"""

from typing import TYPE_CHECKING

from metalens.core.lazy import attach_lazy_exports

__version__ = "0.1.0"

if TYPE_CHECKING:
    from metalens import cell as cell
    from metalens import design as design
    from metalens import fisher as fisher
    from metalens import image as image
    from metalens import lens as lens
    from metalens import library as library
    from metalens import materials as materials
    from metalens import modal as modal
    from metalens import profiles as profiles
    from metalens import propagate as propagate
    from metalens import proxy as proxy
    from metalens import psf as psf
    from metalens import rcwa as rcwa

__getattr__, __dir__, __all__ = attach_lazy_exports(
    __name__,
    {
        "cell": "",
        "design": "",
        "fisher": "",
        "image": "",
        "lens": "",
        "library": "",
        "materials": "",
        "modal": "",
        "profiles": "",
        "propagate": "",
        "proxy": "",
        "psf": "",
        "rcwa": "",
    },
)
