# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A visible lens of NA 0.8
#
# Titanium dioxide pillars on glass focus green light of 532 nm to less than a wavelength. At this aperture light is no scalar:
# the component along the axis fills the first dark ring of Airy's pattern, which knows no polarisation.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.special import j1

from metalens import lens, library, psf
from metalens.cli import main

folder = Path(tempfile.mkdtemp())
settings = "cells/tio2_532.toml"
main(f"library {settings} -o {folder}/tio2.h5 --accept-partial-turn --quiet".split())

# %% [markdown]
# ## The meta-atoms
#
# No pillar of this height covers a whole turn, so `--accept-partial-turn` is needed: each site gets the pillar whose phase is
# nearest, and the design says what the missing part costs.

# %%
pillars = library.load(folder / "tio2.h5")
proxy = library.proxy_of(pillars)
size_um = np.linspace(*proxy.domain_um, 400)
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3), layout="constrained")
left.plot(size_um * 1e3, proxy.phase_rad(size_um, 0.532) / (2 * np.pi))
left.set(xlabel="diameter / nm", ylabel="phase / turns")
right.plot(size_um * 1e3, proxy.transmission(size_um, 0.532) ** 2)
right.set(xlabel="diameter / nm", ylabel="transmitted power", ylim=(0, 1))
plt.show()

# %% [markdown]
# ## The lens

# %%
design = Path("lenses/tio2_532.toml").read_text(encoding="utf-8")
(folder / "design.toml").write_text(design, encoding="utf-8")
main(f"design {folder}/design.toml -o {folder}/lens.h5 --accept-partial-turn".split())

# %% [markdown]
# ## The focus
#
# Unpolarised light: `polarisation="vector"` sums |E|² of all three components for both polarisations.

# %%
made = lens.load(folder / "lens.h5")
view = psf.View(depths_um=(np.inf,), window_um=4.0, samples=81)
stack = psf.from_lens(made, view, polarisation="vector", tolerance=1e-3)
light = np.asarray(stack.intensity).reshape(81, 81)
light = light / light.max()
print(f"relative error of the PSF {stack.error:.0e}")

x_um = (np.arange(81) - 40) * 4.0 / 81
u = 2 * np.pi / 0.532 * 0.8 * np.where(x_um == 0, 1e-9, x_um)
figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
left.imshow(light**0.5, extent=(-2, 2, -2, 2), cmap="inferno")
left.set(xlabel="x / µm", ylabel="y / µm", title="square root of the intensity")
right.plot(x_um, light[40], label="lens, all components of the field")
right.plot(x_um, (2 * j1(u) / u) ** 2, "k:", label="Airy pattern (scalar)")
right.set(xlabel="distance from the axis / µm", ylabel="intensity", xlim=(-1.2, 1.2))
right.legend()
plt.show()
