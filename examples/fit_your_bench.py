# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # Fit your bench
# Captures in, the lens that was really made out, with its uncertainty. Here a virtual bench takes the place of yours:
# it sums over every pillar of a lens whose errors the fit does not know.

# %%
import numpy as np

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.captures.capture import Capture
from characterize.inference.estimate import FitOptions, fit
from characterize.model.parameters import KnownValue
from characterize.model.pillar_slopes import log_response_slopes
from metalens import design
from metalens.cell.record import Cell
from metalens.library.proxy import Proxy

# %% [markdown]
# A small lens. Yours comes from `metalens design`, its proxy from `metalens library`.

# %%
phase, level = np.zeros((2, 4)), np.zeros((2, 4))
phase[0, :3], phase[1, :2], level[0] = (
    (4.0, 3.9, 0.4),
    (-0.2, -0.15),
    (0.88, -0.03, 0.02, 0.03),
)
proxy = Proxy(phase, level, (0.09, 0.26), (0.83, 0.87), 1e-3, 1e-3)
focus = design.Focus(0.85, 110.0, 600.0)
shape = design.phase_of(None, focus, radius_um=20.0)
lens, quality = design.make(
    shape, focus, aperture_um=40.0, cell=Cell(pitch_um=0.4), proxy=proxy
)

# %% [markdown]
# The bench: five source depths, pillars 3 nm too wide, a little coma, a stage that is off by 9 um.
# Your own folder is read by `characterize.load("captures")`: frames, `stage.csv`, `dark.tif`, `flat.tif`, `capture.toml`.

# %%
hidden = {
    "bias_nm": 3.0,
    "coma_x_rad": 0.2,
    "stage_zero_um": 9.0,
    "crosstalk_px": 0.25,
    "background_e": 20.0,
}
truth = HiddenLens(
    (380.0, 480.0, 600.0, 800.0, 1150.0),
    peak_e=6000.0,
    parameter=tuple(KnownValue(name, value) for name, value in hidden.items()),
    camera=BenchCamera(pixel_um=1.5, pixels=16),
)
shots = bench.simulate_frames(lens, truth, log_response_slopes(lens))
depths, angles = truth.stated
unknown = np.full(len(depths), np.nan)
names = tuple(f"frame {i}" for i in range(len(depths)))
captures = Capture(
    shots.frames,
    depths,
    angles,
    unknown,
    names,
    12,
    1.5,
    0.85,
    dark=shots.dark,
    about={"gain_e": 2.0, "read_noise_e": 2.0},
)

# %% [markdown]
# The fit, with what an AFM and a spectrometer say as prior knowledge.

# %%
told = (KnownValue("height_nm", 0.0, 3.0), KnownValue("wavelength_nm", 0.0, 0.1))
built = fit(captures, lens, FitOptions(known=told, scan_um=60.0))
for name, value, sigma in zip(built.names, built.value, built.sigma, strict=True):
    true = (
        "" if name == "log_gain" else f"true {hidden.get(name, 0.0):6.2f}"
    )  # the light of the bench is its own
    print(f"{name:<24} {value:9.3f} +- {sigma:.3f}   {true}")
print(f"chi² / dof {built.chi2_per_dof:.3f}; {built.reason}")

# %% [markdown]
# What the frames cannot tell apart, and what to measure next. Draws from the posterior are for training under uncertainty.

# %%
print("\n".join((*built.degeneracies, *built.cautions)))
lenses = [built.lens(draw) for draw in built.lens_samples(3, seed=0)]
print([f"{each.diameters.diameter_um.max():.4f}" for each in lenses])
