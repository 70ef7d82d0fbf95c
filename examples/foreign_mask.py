# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A mask from another tool, checked and corrected
#
# A GDSII file comes from somebody else's program: a wide pad, dense lines beside it, and two discs that nearly touch. Which
# places violate your rules, and which dose does each shape need?

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

import layout
from layout.formats.library import MaskCell, MaskLibrary
from layout.process.process import DesignRules, ExposureSettings
from layout.shapes.polygon import disc_polygon

pad = np.array([[0, 0], [20_000, 0], [20_000, 15_000], [0, 15_000]])  # nm
line = np.array([[20_400, 0], [20_520, 0], [20_520, 15_000], [20_400, 15_000]])
lines = [line + np.array([260 * i, 0]) for i in range(40)]
discs = [disc_polygon(300, (x, 4000), 64) for x in (34_000, 34_642)]
shapes = {(4, 0): [pad, *lines, *discs]}
path = Path(tempfile.mkdtemp()) / "chip.gds"
layout.write_gdsii(MaskLibrary("chip", {"chip": MaskCell("chip", shapes)}), path)

# %% [markdown]
# ## Design rules
#
# Every layer is checked, or listed as skipped. Widths and spaces are measured in projection, as KLayout does.
# The command is `metalens check chip.gds --process process.toml`.

# %%
report = layout.check(path, DesignRules(minimum_feature_nm=100, minimum_gap_nm=60))
print(report.summary)
for violation in report.violations:
    x, y = (place * report.unit_nm * 1e-3 for place in violation.centre)
    print(f"{violation.rule} at ({x:.2f}, {y:.2f}) µm: {violation.summary}")

# %% [markdown]
# ## Proximity effect correction
#
# Electrons that scatter back expose the middle of the pad most and its corners least. `layout.correct` divides every polygon
# and gives each piece the dose at which its edges come to size. The command is `metalens dose chip.gds --process process.toml`.

# %%
exposure = ExposureSettings(alpha_um=0.02, beta_um=5.0, eta=0.7)
dosed = layout.correct(path, exposure)
pieces, doses = zip(
    *(
        (piece * 1e-3, dosed.doses[layer])
        for layer, listed in dosed.cells["chip"].polygons.items()
        for piece in listed
    ),
    strict=True,
)
print(f"{len(set(doses))} doses from {min(doses):.3f} to {max(doses):.3f}")
inside, edge = (1 + 0.7) / (1 + 2 * 0.7), (1 + 0.7) / np.sqrt(1 + 2 * 0.7)
print(f"theory of a wide pad: {inside:.3f} inside, {edge:.3f} at its edge")

figure, axes = plt.subplots(figsize=(9, 4.2), layout="constrained")
drawn = PolyCollection(pieces, array=doses, cmap="viridis")
axes.add_collection(drawn)
axes.set(xlabel="x / µm", ylabel="y / µm", xlim=(-1, 36), ylim=(-1, 16), aspect="equal")
figure.colorbar(drawn, label="dose / dose to clear a wide edge")
plt.show()
