# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # A mask and its tolerance
#
# A lens file says which pillar stands where. A mask must say what to *draw*, with which dose, in which write fields, so that those pillars
# are what comes out of the etch. And before money is spent on it, one wants to know what the process may do to the picture. This
# notebook takes a small lens (0.3 mm, the paper's NA of 0.24) through all of it.

# %%
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from scipy.signal import resample

import layout
from layout import solids
from layout.mask import fields
from layout.process import process
from layout.study import sensitivity, stitching, tolerance
from layout.verify.exposure import verify_exposure
from metalens import design, library
from metalens.design.profiles import Focus

rules = process.load_process("process.toml")
focus = Focus(wavelength_um=0.85, sensor_distance_um=600.0, source_distance_um=20_000.0)
proxy = library.proxy_of(library.sweep(library.DEFAULT_CELL))
lens, quality = design.make(
    design.phase_of(None, focus, radius_um=150.0),
    focus,
    aperture_um=300.0,
    cell=library.DEFAULT_CELL,
    proxy=proxy,
    limits=design.Limits(min_diameter_nm=82.0, min_gap_nm=70.0),
    profile="hyperbolic",
)
print(
    f"{quality.pillars:,} pillars, NA {quality.numerical_aperture:.3f}, Strehl {quality.strehl:.4f}"
)

# %% [markdown]
# ## What is drawn is not what is made
#
# Exposure and etch change a diameter, thin pillars more than thick ones. `process.toml` holds the bias from micrographs; the drawn
# diameter is the one that makes the designed one. Corners that round off take a little more, and a pillar with no neighbours comes
# out thinner still.

# %%
designed = np.arange(82.0, 232.0, 2.0)
figure, axes = plt.subplots(figsize=(6, 3.2))
for alone, label in ((0.0, "in the full lattice"), (1.0, "standing alone")):
    drawn = rules.written_diameter_nm(designed, alone)
    axes.plot(designed, drawn - designed, label=label)
    back = abs(rules.made_diameter_nm(drawn, alone) - designed).max()
    print(f"{label}: made again to {back:.0e} nm")
axes.set(xlabel="designed diameter / nm", ylabel="drawn − designed / nm")
axes.legend()
plt.show()

# %% [markdown]
# ## The mask
#
# Diameters become classes, classes become equal-area polygons on the grid; the design rules are checked on the written polygons, and
# the file is read back and compared before anyone believes it. (`metalens layout lens.h5 --process process.toml` does this and writes a
# report.)

# %%
plan = layout.plan(lens, rules)
report = layout.check(plan, rules.rules)
print(report.summary)
folder = Path(tempfile.mkdtemp())
layout.write_oasis(plan, folder / "mask.oas")
same = layout.compare(plan, layout.read_oasis(folder / "mask.oas"))
print(
    f"{(folder / 'mask.oas').stat().st_size / 1e3:.0f} kB, reads back as planned: {same.ok}"
)

# %% [markdown]
# ## Dose: even exposure at every edge
#
# Electrons scatter back over tens of micrometres, so a pillar in the middle of the lens gets more background than one at its rim, and a thin
# pillar has a weaker edge than a thick one. Each pillar gets the dose at which its own edge is exposed just right, rounded to as few
# doses as the tolerance allows. What a file and its dose table make is found by exposing it again.

# %%
dosed = layout.correct(plan, rules.exposure)
layout.write_oasis(dosed, folder / "dosed.oas")
found = verify_exposure(
    layout.read_oasis(folder / "dosed.oas"), dosed, dosed.doses, rules
)
print(
    f"{len(set(dosed.doses.values()))} doses: worst edge {100 * found.worst_exposure:.1f} %, widths off by up to {found.worst_nm:.2f} nm"
)
print(f"error of this calculation: {found.error:.0e}")

lattice = dosed.lattices[0]
given = np.array([np.nan, *(made.dose for made in dosed.classes)])[lattice.whole()]
figure, axes = plt.subplots(1, 2, figsize=(9, 3.6), layout="constrained")
side = lens.diameters.radius_um
shown = axes[0].imshow(given, extent=(-side, side, -side, side), cmap="viridis")
axes[0].set(title="relative dose", xlabel="x / µm", ylabel="y / µm")
figure.colorbar(shown, ax=axes[0])
axes[1].hist(given[np.isfinite(given)] * rules.exposure.base_uC_cm2, bins=40)
axes[1].set(xlabel="dose / (µC/cm²)", ylabel="pillars", title="doses of the lens")
plt.show()

# %% [markdown]
# ## Write fields, and what stitching costs
#
# The tool writes square fields; a border through a pillar would write it in two halves. Borders are therefore put between lattice sites. What
# remains is that fields are misplaced by some nanometres. Here 500 draws of ±20 nm for each field:

# %%
small = process.Process(write_field=process.WriteField(size_um=100.0))
split = fields.split_write_fields(lens.diameters, small)
stitched = stitching.simulate_stitching(lens, split, small)
print(f"{split.used} fields of {split.size_um[0]:.1f} µm; no border cuts a pillar")
print(
    f"peak of the PSF: {stitched.strehl.mean():.5f} on average, {stitched.strehl.min():.5f} at worst"
)
print(
    f"change of the PSF (relative L2): {100 * stitched.change.mean():.2f} %, at worst {100 * stitched.change.max():.2f} %"
)

# %% [markdown]
# ## Which tolerance hurts?
#
# Each cause alone, at its standard deviation from `process.toml`. Diameters enter through the proxy, height, wall and index through
# differences of the solver. What all pillars share is only a common phase; what counts is how *differently* they answer.

# %%
rates = sensitivity.compute_sensitivities(lens, count=9)
study = tolerance.analyse_tolerance(lens, rules, sens=rates, draws=60)
print(
    f"t(D) under all causes lives in {study.rank} dimensions (error {study.error:.0e}); derivatives to {100 * rates.error:.0f} %"
)
print("cause            sigma   phase/rad   peak/%   efficiency/%   PSF/%   I(z)/%")
for e in study.effects:
    print(
        f"{e.cause:14s} {e.deviation:7.3g}   {e.phase_rad:9.3f}  {100 * e.strehl:7.2f}   {100 * e.efficiency:12.2f}  "
        f"{100 * e.psf:6.2f}  {100 * e.information:7.2f}"
    )

# %% [markdown]
# ## All at once: Monte Carlo with bands
#
# Pillars are summed once; a draw of the process only weights the sums, so a draw costs the same for a thousand pillars and for five
# million.

# %%
x = study.window.x_um
fine = np.arange(8 * len(x)) * (x[1] - x[0]) / 8 + x[0]
low, middle, high = (resample(curve, len(fine)) for curve in study.band("psf"))
figure, axes = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
axes[0].fill_between(fine, low, high, alpha=0.3, label="5 to 95 %")
axes[0].plot(fine, middle, label="median")
axes[0].plot(
    fine, resample(study.nominal.psf[0], len(fine)), "k--", lw=0.8, label="as designed"
)
axes[0].set(
    xlabel="x / µm", ylabel="intensity", title="PSF at the design depth", xlim=(-4, 4)
)
axes[0].legend(fontsize=7)
axes[1].hist(study.draws.efficiency * 100, bins=15)
axes[1].axvline(100 * study.nominal.efficiency[0], color="k", ls="--")
axes[1].set(xlabel="efficiency / %", ylabel="draws")
low, middle, high = study.band("information")
axes[2].errorbar(
    study.depths_um / 1e3, middle, [middle - low, high - middle], fmt="o", capsize=4
)
axes[2].plot(study.depths_um / 1e3, study.nominal.information[0], "k_", ms=14)
axes[2].set(
    xlabel="depth / mm",
    ylabel="I(z) / µm⁻²",
    yscale="log",
    title="axial information (Eq. 11)",
)
plt.show()

# %% [markdown]
# ## Solids
#
# A tile of the pillars as they are fabricated, for CAD.

# %%
tile = solids.cut_tile(lens, rules, side_um=6.0)
solids.write_step(folder / "tile.step", tile)
print(
    f"{len(tile.kind)} pillars in {(folder / 'tile.step').stat().st_size / 1e3:.0f} kB of STEP"
)
