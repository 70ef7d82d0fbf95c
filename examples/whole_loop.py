# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # The whole loop on a small lens
# Design a lens and a network that reads the eye through it; draw the mask; let a virtual fab make it wrong; measure it
# on a virtual bench; fit what was made; train the network on for it; and correct the next mask. Every step is a command
# with the same name; here they are called as functions, on a lens of 0.2 mm so that it takes a minute or two.

# %%
import tempfile
import tomllib
from importlib import resources
from pathlib import Path

from IPython.display import Image, display

from characterize import next_mask
from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.captures import capture as captures
from characterize.commands import capture as command_capture
from characterize.inference.estimate import FitOptions, fit
from characterize.model.parameters import KnownValue
from codesign.adapt import report as retrain_report
from codesign.adapt import train as retraining
from codesign.settings import RetrainConfig
from metalens import lens as lenses
from metalens.cli import main
from metalens.fabrication import proxy_sensitivity

work = Path(tempfile.mkdtemp())

# %% [markdown]
# ## 1. Co-design
# The run file of `metalens demo`, with fewer steps: one small network before a hyperbolic lens, over the preset `smoke`.
# (A minute of training reads the pupil and the sideways slip; the distance takes some twenty minutes: see the preset
# `laptop`.)

# %%
settings = (
    resources.files("metalens")
    .joinpath("data", "demo", "run.toml")
    .read_text(encoding="utf-8")
)
settings = settings.replace("steps = 400", "steps = 60").replace(
    "pool = 512", "pool = 256"
)
print(settings)
(work / "run.toml").write_text(settings)
main(["codesign", str(work / "run.toml"), "-o", str(work / "run"), "--quiet"])
design = lenses.load(work / "run" / "lens.h5")
print(f"{(design.diameters.diameter_um > 0).sum():,} pillars")

# %% [markdown]
# ## 2. The mask
# Written, checked against the design rules and read back.

# %%
process = Path("process.toml").resolve()
main(
    [
        "layout",
        str(work / "run" / "lens.h5"),
        "--process",
        str(process),
        "-o",
        str(work / "mask"),
        "--oasis",
    ]
)

# %% [markdown]
# ## 3. What the fab made, and its captures
# Pillars 5 nm too wide, more so at the rim; some coma; the sensor 12 um too far away. The fit knows none of this.

# %%
hidden = {"bias_nm": 5.0, "bias_r_nm": 3.0, "coma_x_rad": 0.3, "distance_um": 12.0}
truth = HiddenLens(
    (2500.0, 3200.0, 4200.0, 6000.0, 10e3, 20e3),
    parameter=tuple(KnownValue(name, value) for name, value in hidden.items()),
    camera=BenchCamera(pixel_um=2.0, pixels=32),
)
shots = bench.simulate_frames(design, truth, proxy_sensitivity(design))
(work / "captures").mkdir()
command_capture.write_captures(work / "captures", shots, truth, design)

# %% [markdown]
# ## 4. The lens as built
# With intervals, and with what cannot be told apart.

# %%
made = fit(captures.load(work / "captures"), design, FitOptions())
for name in hidden:
    low, high = made.interval(name)
    print(f"{name:<14} true {hidden[name]:6.2f}   fitted {low:7.2f} to {high:7.2f}")
print("\n".join(made.degeneracies))
made.save(work / "asbuilt.h5")

# %% [markdown]
# ## 5. The network trained on for it
# Training draws lenses from the posterior of the fit. `before` is the network that nobody warned.

# %%
told = retraining.retrain_network(
    work / "run",
    made,
    config=RetrainConfig(steps=20, draws=3, judge=1, test_batches=4),
    truth=truth,
)
for name, row in told.rows().items():
    print(
        f"{retrain_report.CASES[name]:<38} {row['slip_mm']:.3f} mm  [{row['slip_low_mm']:.3f}, {row['slip_high_mm']:.3f}]"
    )
display(Image(retrain_report.plot_error_bars(told)))

# %% [markdown]
# ## 6. The next mask
# A new bias table and a corrected map, and what they would gain on the true lens.

# %%
old = next_mask.present_bias(process)
mask = next_mask.plan_next_mask(made, old=old, truths=[truth.vector()])
next_mask.write_correction(work, mask.plan)
print(tomllib.loads((work / "bias.toml").read_text())["bias"]["table_nm"][::4])
for step in mask.steps:
    print(f"{step.name:<26} Strehl {step.strehl:.3f}")
print(mask.summary)

# %% [markdown]
# From the shell, the last two steps are one command, with its own report:
# `metalens retrain run --asbuilt asbuilt.h5 --truth truth.toml --process process.toml -o retrained`
