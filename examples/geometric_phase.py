# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Geometric phase
#
# A half-wave plate turned by an angle gives circular light of the other hand twice that angle as phase (Pancharatnam and
# Berry). Here rectangles of amorphous silicon are the plates: they have one size, and their turn sets the phase.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from metalens import lens
from metalens.cli import main
from metalens.psf import focus_scan

folder = Path(tempfile.mkdtemp())
main(f"library cells/a_si_rectangle_940.toml -o {folder}/rectangle.h5 --quiet".split())

# %% [markdown]
# ## The lens
#
# The design turns every rectangle by half of its target phase. The light that keeps its hand is a loss, and is stated.

# %%
design = Path("lenses/a_si_rectangle_940.toml").read_text(encoding="utf-8")
(folder / "design.toml").write_text(design, encoding="utf-8")
main(f"design {folder}/design.toml -o {folder}/lens.h5".split())

made = lens.load(folder / "lens.h5")
sites = made.diameters
figure, axes = plt.subplots(figsize=(5, 4), layout="constrained")
edge = sites.radius_um
turn = np.where(sites.diameter_um > 0, np.degrees(sites.angle_rad), np.nan)
shown = axes.imshow(turn, extent=(-edge, edge, -edge, edge), cmap="twilight")
axes.set(xlabel="x / µm", ylabel="y / µm")
figure.colorbar(shown, label="turn of the rectangle / degrees")
plt.show()

# %% [markdown]
# ## The focus
#
# Collimated light comes to a focus 0.1 mm behind the lens. A scan along the axis shows it narrow and widen again.

# %%
scan = focus_scan(made)
width_um = scan.fwhm_um[scan.peak.argmax()]
print(f"full width at half maximum {width_um:.2f} µm")
print(f"diffraction limit 0.51 λ / NA = {0.51 * 0.94 / np.sin(np.arctan(0.3)):.2f} µm")
figure, axes = plt.subplots(figsize=(6, 3.4), layout="constrained")
axes.pcolormesh(
    scan.shift_um, scan.x_um, np.sqrt(scan.slices).T, shading="gouraud", cmap="inferno"
)
axes.set(xlabel="distance from the sensor / µm", ylabel="x / µm", ylim=(-15, 15))
plt.show()
