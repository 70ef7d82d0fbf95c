# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # From one pillar to a library you can trust
#
# A metalens is a choice of a pillar diameter for each of several million sites. That choice is only as good as the curve
# *diameter → phase and transmission* behind it. This notebook shows how that curve is computed, how wrong it is, and how the
# default cell was chosen. Nothing here needs more than a laptop.

# %%
import time

import matplotlib.pyplot as plt
import numpy as np

from metalens import library, modal, rcwa
from metalens.cell.record import Cell, Index

cell = Cell(pitch_um=0.40, height_um=0.7, pillar=Index(3.6), substrate=Index(1.4525))
WAVELENGTH_UM = 0.85

# %% [markdown]
# ## Two solvers that share no code
#
# RCWA expands the fields in plane waves; the modal method puts curved finite elements on the disc and is exact along z. They agree
# to the error that RCWA states, and each result says how wrong it may be. The pillars below include the two hard ones of this
# cell: the dip near 193.7 nm and the steep flank near 302 nm.

# %%
diameters = np.array([0.080, 0.128, 0.1937, 0.200, 0.272, 0.302, 0.320])
print("diameter    RCWA - modal    RCWA's estimate    modal's estimate")
for d in diameters:
    fine = modal.solve(cell, d, WAVELENGTH_UM, tolerance=1e-4)
    plane = rcwa.solve(cell, d, WAVELENGTH_UM, tolerance=1e-2)
    print(
        f"{d * 1e3:6.1f} nm      {abs(plane.t - fine.t):.1e}          {plane.t_error:.1e}             {fine.t_error:.1e}"
    )

# %% [markdown]
# ## Convergence
#
# Ask for less error and pay in time. The true error is measured against the finest solution; it stays below the estimate.

# %%
figure, axes = plt.subplots(figsize=(6, 4))
measured = {}
for solver, tolerances in ((modal, (1e-3, 1e-4, 1e-5)), (rcwa, (1e-1, 3e-2, 1e-2))):
    seconds, solved = [], []
    for tolerance in tolerances:
        start = time.perf_counter()
        solved.append(solver.solve(cell, 0.301, WAVELENGTH_UM, tolerance=tolerance))
        seconds.append(time.perf_counter() - start)
    measured[solver.__name__.split(".")[-1]] = seconds, solved

# last: modes that it leaves in memory would make the solves above look free
reference = modal.solve(cell, 0.301, WAVELENGTH_UM, tolerance=1e-6).t
for name, (seconds, solved) in measured.items():
    error = [abs(found.t - reference) for found in solved]
    estimate = [found.t_error for found in solved]
    (line,) = axes.loglog(seconds, error, "o-", label=f"{name}: true error")
    axes.loglog(
        seconds, estimate, "--", color=line.get_color(), label="its own estimate"
    )
axes.set(xlabel="time / s", ylabel="|Δt|", title="301 nm pillar, the steep flank")
axes.legend()
plt.show()

# %% [markdown]
# ## The library
#
# t(D) is a meromorphic function: a few poles (resonances) and otherwise smooth. A rational function through a few dozen exact solves
# therefore gives every diameter, with an error bar on each.

# %%
default = library.sweep(library.DEFAULT_CELL)
print(f"{default.solves} exact solves; largest error bar {default.t_error.max():.1e}")
proxy = library.proxy_of(default)
print(
    f"proxy: {proxy.domain_um[0] * 1e3:.0f}-{proxy.domain_um[1] * 1e3:.0f} nm, held-out error "
    f"{proxy.max_phase_error_rad:.1e} rad and {proxy.max_transmission_error:.1e} in |T|"
)
for note in default.notes:
    print(note)

# %%
t = default.t[0, 0, 0]
smooth = np.linspace(*proxy.domain_um, 300)
figure, (top, bottom) = plt.subplots(
    2, 1, figsize=(7, 5), sharex=True, layout="constrained"
)
top.plot(
    default.diameter_um * 1e3, np.unwrap(np.angle(t)) / (2 * np.pi), label="library"
)
top.plot(
    smooth * 1e3,
    proxy.phase_rad(smooth, WAVELENGTH_UM) / (2 * np.pi),
    "--",
    label="proxy on its domain",
)
top.set(ylabel="phase / turns")
top.legend()
bottom.errorbar(default.diameter_um * 1e3, np.abs(t), yerr=default.t_error[0, 0, 0])
bottom.plot(smooth * 1e3, proxy.transmission(smooth, WAVELENGTH_UM), "--")
bottom.set(xlabel="diameter / nm", ylabel="|t|")
plt.show()

# %% [markdown]
# ## Why a pitch of 300 nm?
#
# The cell study (`metalens study`, published in `docs/cell_study`) asks for every pitch and height how many turns of phase the longest
# smooth stretch of printable diameters covers. A 400 nm pitch looks comfortable, but its resonances cut the curve: below, the same
# pillars at two pitches.

# %%
figure, axes = plt.subplots(figsize=(7, 3.5), layout="constrained")
for pitch in (0.30, 0.40):
    made = library.sweep(
        Cell(pitch, 0.7, pillar=Index(3.6)),
        library.Sweep(diameters_um=(0.08, pitch - 0.06)),
    )
    axes.plot(
        made.diameter_um * 1e3,
        np.abs(made.t[0, 0, 0]),
        label=f"pitch {pitch * 1e3:.0f} nm",
    )
axes.axhline(0.8, color="grey", lw=0.8)
axes.set(
    xlabel="diameter / nm", ylabel="|t|", title="A resonance is a hole in the lens"
)
axes.legend()
plt.show()
