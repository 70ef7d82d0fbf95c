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
# # PSF engine: speed against error of every method
#
# A point source, a lens of pillars, a sensor: how long does the image of the source take, and how wrong is it? The referee
# is the direct Rayleigh-Sommerfeld sum over all pillars in float64. Everything else is measured against it, on one lens
# small enough for the referee to finish.

# %%
import sys
import time

import matplotlib.pyplot as plt
import numpy as np
import torch

sys.path.insert(
    0, ".."
)  # the rivals that this page measures lie beside the folder of examples

from benchmarks.peers import lowrank
from benchmarks.peers.angular_spectrum import angular_spectrum
from benchmarks.peers.radial import Radial, field_radial
from metalens import fisher, propagate, psf

torch.set_num_threads(2)
WAVELENGTH, PITCH, D, SOURCE, RADIUS = 0.85, 0.4, 400.0, 4000.0, 100.0
K = 2 * np.pi / WAVELENGTH
DEPTHS = np.linspace(3200.0, 5200.0, 21)


def profile(r):
    """Phase that brings a source at 4 mm to a focus on the sensor."""
    return -K * (r * r / (np.hypot(r, D) + D) + r * r / (np.hypot(r, SOURCE) + SOURCE))


lens = Radial(profile, np.ones_like, RADIUS)
phase, transmission = lens.maps((500, 500), PITCH)
geometry = dict(
    pitch_um=PITCH,
    wavelength_um=WAVELENGTH,
    sensor_distance_um=D,
    window_um=24 * 2 * PITCH,
    samples=24,
)
on_lattice = geometry | dict(
    offset_um=(PITCH / 2, PITCH / 2)
)  # where the angular spectrum has its samples


def timed(work, repeats=3):
    """(result, seconds of the fastest call after a first one)."""
    result = work()
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        result = work()
        best = min(best, time.perf_counter() - start)
    return result, best


def normalised(field):
    power = np.abs(field) ** 2
    return power / power.sum((1, 2), keepdims=True)


start = time.perf_counter()
exact = {
    name: normalised(propagate.exact(phase, transmission, **g, depths_um=DEPTHS))
    for name, g in (("centre", geometry), ("lattice", on_lattice))
}
exact_seconds = (time.perf_counter() - start) / 2
print(f"exact sum: {exact_seconds:.2f} s for 21 depths of 24 x 24 samples")


# %%
def error(got, name="centre"):
    return np.linalg.norm(got - exact[name]) / np.linalg.norm(exact[name])


points = {"exact sum": [(exact_seconds, 1e-12)]}
some = DEPTHS[::10]
for label, options in (
    ("angular spectrum, complex64", dict(single=True)),
    ("angular spectrum, pad 4", dict(pad=4)),
):
    field, seconds = timed(
        lambda o=options: angular_spectrum(
            phase, transmission, **on_lattice, depths_um=some, **o
        ),
        1,
    )
    want = exact["lattice"][::10]
    points[label] = [
        (
            seconds * len(DEPTHS) / len(some),
            np.linalg.norm(normalised(field) - want) / np.linalg.norm(want),
        )
    ]

maps = {torch.float32: torch.tensor(phase).float(), torch.float64: torch.tensor(phase)}
level = torch.tensor(transmission)
ladder = []
for tolerance in (1e-2, 1e-3, 1e-4, 1e-5, 1e-6, 1e-9):
    dtype = torch.float32 if tolerance >= 1e-6 else torch.float64
    stack, seconds = timed(
        lambda t=tolerance, d=dtype: psf.psf_stack(
            maps[d], level, **geometry, depths_um=DEPTHS, tolerance=t
        )
    )
    ladder.append((tolerance, seconds, error(stack.numpy().intensity), stack.error))
points["windowed, forward"] = [(seconds, wrong) for _, seconds, wrong, _ in ladder]


def gradient(tolerance):
    given = maps[torch.float32].clone().requires_grad_()
    stack = psf.psf_stack(
        given, level, **geometry, depths_um=DEPTHS, tolerance=tolerance
    )
    (stack.intensity**2).sum().backward()
    return stack


points["windowed, forward and gradient"] = []
for tolerance in (1e-3, 1e-4, 1e-6):
    stack, seconds = timed(lambda t=tolerance: gradient(t))
    points["windowed, forward and gradient"].append(
        (seconds, error(stack.numpy().intensity))
    )

case = propagate.make_case(phase.shape, **geometry, depths_um=DEPTHS)
hankel, seconds = timed(lambda: field_radial(lens, case, 1e-5))
points["Hankel (radial lens)"] = [(seconds, error(normalised(hankel.field)))]

# %% [markdown]
# **One page.** Down and left is better. The angular spectrum costs the same whatever error one wants, and its error is not
# known to it; the windowed method computes only what reaches the sensor and is told how exact to be.

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(12, 4.2), layout="constrained")
for label, values in points.items():
    seconds, wrong = np.array(values).T
    left.loglog(seconds * 1e3, wrong, "o-", label=label)
left.set(
    xlabel="time for 21 depths / ms",
    ylabel="relative L2 error of the PSFs",
    title="speed against error",
)
left.legend(fontsize=7)
left.grid(alpha=0.3)
tolerance, _, wrong, estimate = np.array(ladder).T
right.loglog(tolerance, tolerance, "k:", label="tolerance")
right.loglog(tolerance, wrong, "o-", label="true error")
right.loglog(tolerance, estimate, "s--", label="error estimate of the result")
right.set(
    xlabel="tolerance asked for",
    title="the estimate stays above the truth, and within three times of it",
)
right.legend(fontsize=8)
right.grid(alpha=0.3)
plt.show()
print("estimate / truth:", np.round(estimate / wrong, 2))

# %% [markdown]
# **Which method?** `choose` weighs the exact sum against the windowed method and says why.

# %%
for shape, samples in (((8, 8), 4), ((500, 500), 24), ((2500, 2500), 64)):
    picked = propagate.choose_method(
        propagate.make_case(
            shape, **geometry | dict(samples=samples), depths_um=DEPTHS
        ),
        1e-4,
    )
    print(
        f"{shape[0]} x {shape[1]} pillars, {samples} x {samples} samples: {picked.reason}"
    )

# %% [markdown]
# **Depth as a few pictures.** Image formation needs many depths; a handful of basis PSFs carries them all.

# %%
stack = psf.psf_stack(
    phase, transmission, **geometry, depths_um=np.linspace(3200, 5200, 41)
)
for tolerance in (1e-1, 1e-2, 1e-3):
    small = lowrank.compress(stack, tolerance=tolerance)
    print(
        f"tolerance {tolerance:g}: {small.rank} basis PSFs for 41 depths, measured error {small.errors.max():.1e}"
    )

# %% [markdown]
# **The normalisation decides the ranking.** I(z) of Eq. 11 for this lens under two names.

# %%
light = torch.tensor(stack.intensity)
step_um = float(np.diff(stack.depths_um)[0])
figure, axes = plt.subplots(1, 2, figsize=(10, 3), layout="constrained")
for panel, name in zip(axes, ("sum", "l2"), strict=True):
    value = fisher.axial_information(
        light[:-1],
        light[1:],
        step_um=step_um,
        sample_um=stack.step_um,
        pixel_um=3 * stack.step_um,
        normalisation=name,
    )
    panel.plot((stack.depths_um[1:] + stack.depths_um[:-1]) / 2e3, value)
    panel.set(title=f"normalised by {name}", xlabel="depth / mm", ylabel="I(z) / mm⁻²")
plt.show()
