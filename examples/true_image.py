# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     language: python
#     name: python3
# ---

# %% [markdown]
# # From one PSF to the image of the device
#
# A lens of one surface is sharp at one wavelength, in one direction. A device looks at a whole field, in the light of a
# diode, through the glass of its sensor. This page takes a scene through one PSF, then adds what was left out, one cause
# after the other, and says how much of the picture each of them changes.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch

from metalens.cell import Film
from metalens.design import Focus
from metalens.image import Frames, Grid, SmoothWave, imager, uniform_imager
from metalens.optics import Layers
from metalens.psf import Source

torch.set_num_threads(2)
WAVELENGTH, D, SOURCE, RADIUS = (
    0.85,
    2000.0,
    20e3,
    500.0,
)  # um: an eye tracker of 1 mm at NA 0.24
LED = Source(850.0, 30.0)  # nm: peak and full width at half maximum
GLASS = Layers(behind=(Film("N-BK7", 400.0),))  # cover of the sensor
GRID = Grid((96, 96), 12.0, (15e3, 28e3), margin=12, window=33)
SIDE = GRID.samples[0] + 2 * GRID.margin
half_deg = np.degrees(np.arctan(GRID.samples[0] / 2 * GRID.step_um / D))
print(f"±{half_deg:.0f} degrees on {GRID.samples[0]} samples of {GRID.step_um:g} um")

# %% [markdown]
# **The scene.** A far wall that leans from 19 to 28 mm, and a near strip at 16 mm. Spots and spokes show blur best.

# %%
y, x = torch.meshgrid(
    *(torch.arange(SIDE) - (SIDE - 1) / 2 for _ in "yx"), indexing="ij"
)
spots = (((x + 8) % 16 - 8).abs() < 1.0) & (((y + 5) % 16 - 8).abs() < 1.0)
spokes = (torch.sin(14 * torch.atan2(y - 7, x + 4)) > 0) & (
    torch.hypot(x + 4, y - 7) < 30
)
wall = 0.1 + 0.8 * (spots | spokes)
strip = torch.sigmoid(2 * (y - 0.2 * x - 36))
stripes = 0.3 + 0.6 * ((x // 6) % 2)
cover = torch.stack([strip, 1 - strip])
radiance = torch.stack([strip * stripes, (1 - strip) * wall])
depth = torch.stack([torch.full_like(x, 16e3), 23.5e3 + 4.5e3 * x / (SIDE / 2)])
scene = Frames(*(part.float()[None] for part in (radiance, cover, depth)))

# %% [markdown]
# **Four imagers.** Each is prepared once, to one per cent of the image; `parts` says what its error is made of.

# %%
lens = SmoothWave(Focus(WAVELENGTH, D, SOURCE), RADIUS)
corrected = SmoothWave(
    Focus(WAVELENGTH, D, SOURCE, GLASS), RADIUS
)  # designed for the glass
cases = {
    "field": dict(lens=lens),
    "field and spectrum": dict(lens=lens, spectrum=LED),
    "field, spectrum, glass unknown to the design": dict(
        lens=lens, spectrum=LED, layers=GLASS
    ),
    "field, spectrum, glass in the design": dict(
        lens=corrected, spectrum=LED, layers=GLASS
    ),
}
made = {}
for name, given in cases.items():
    made[name] = imager(given.pop("lens"), GRID, tolerance=1e-2, **given)
    nodes = f"{len(made[name].plan.y_um)}² field points, {len(made[name].plan.depths_um)} depths"
    print(
        f"{name}: {nodes}, {len(made[name].plan.waves.weights)} wavelengths; error {made[name].error:.1e}"
    )

# %% [markdown]
# **PSFs over the field**, all of one depth: sharp on the axis at one wavelength; a comet at 20 degrees; and the diode fills
# what was dark.


# %%
def along(one, count=4):
    """PSFs from the middle to the edge of the field, at the depth nearest to the lens's own."""
    middle = len(one.plan.x_um) // 2
    there = int((one.plan.depths_um - SOURCE).abs().argmin())
    columns = np.linspace(middle, len(one.plan.x_um) - 1, count).round().astype(int)
    tangents = one.plan.x_um[columns] / D
    return np.degrees(np.arctan(tangents)), one.stack[middle, columns, there].numpy()


figure, axes = plt.subplots(2, 4, figsize=(9, 4.6), layout="constrained")
for row, name in zip(axes, ("field", "field and spectrum"), strict=True):
    for panel, angle, psf in zip(row, *along(made[name]), strict=True):
        panel.imshow(np.sqrt(psf / psf.max()), cmap="magma")
        panel.set(title=f"{angle:.0f}°", xticks=[], yticks=[])
    row[0].set_ylabel(name)
figure.suptitle("square root of the PSFs, each at its own full scale")
plt.show()

# %% [markdown]
# **The same scene through each.** The one-PSF image blurs everything with the PSF of the axis, at one wavelength: what most
# simulations do. The numbers are relative L2 differences from the image above them in the list.

# %%
flat = made["field"]
middle = len(flat.plan.x_um) // 2
centre = flat.stack[middle, middle]
one = uniform_imager(centre, flat.plan.depths_um, GRID, tolerance=1e-4)
with torch.no_grad():
    seen = {"one PSF": one(scene)[0]}
    seen |= {name: each(scene)[0] for name, each in made.items()}

figure, axes = plt.subplots(1, len(seen), figsize=(14, 3.2), layout="constrained")
before = None
for panel, (name, picture) in zip(axes, seen.items(), strict=True):
    panel.imshow(picture / picture.mean(), cmap="gray", vmin=0, vmax=2.2)
    changed = (
        ""
        if before is None
        else f"\nchanges {float((picture - before).norm() / before.norm()):.0%}"
    )
    panel.set_title(name.replace(", glass", ",\nglass") + changed, fontsize=9)
    panel.set(xticks=[], yticks=[])
    before = picture
plt.show()

# %% [markdown]
# Coma, field curvature and astigmatism change most. A diode of 30 nm adds little on samples of 12 um: the field's blur is
# wider. Glass that the design does not know moves the focus; a design that knows it gets it back. What one PSF says about
# depth is true near the axis alone.
#
# **Light over the field**: what a sample of the sensor gets of a scene of one radiance (cos⁴, and the light that leaves
# the PSF's window).

# %%
flat_scene = Frames(
    torch.stack([torch.zeros_like(x), torch.ones_like(x)])[None],
    cover[None] * 0 + torch.tensor([0.0, 1.0])[None, :, None, None],
    scene.depth_um,
)
with torch.no_grad():
    level = made["field and spectrum"](flat_scene)[0]
row = level[level.shape[0] // 2].numpy()
tangents = (np.arange(len(row)) - (len(row) - 1) / 2) * GRID.step_um / D
figure, panel = plt.subplots(figsize=(5, 3), layout="constrained")
panel.plot(np.degrees(np.arctan(tangents)), row / row.max(), label="imager")
panel.plot(
    np.degrees(np.arctan(tangents)), np.cos(np.arctan(tangents)) ** 4, ":", label="cos⁴"
)
panel.set(
    xlabel="field angle / degrees", ylabel="relative illumination", ylim=(0, 1.05)
)
panel.legend()
plt.show()
