# ---
# jupyter:
#   jupytext:
#     text_representation: {extension: .py, format_name: percent}
# ---

# %% [markdown]
# # Co-design in ten minutes
# A lens and a small network learn together to tell how far an eye has slipped towards or away from the camera. The
# frames hold no other cue than blur: every time a frame is drawn, its depth is scaled to one that has nothing to do
# with its picture. Everything here is small enough to run while you read; `metalens codesign RUN.toml` does the same
# with checkpoints, a search over networks and a lens file at the end.

# %%
import matplotlib.pyplot as plt
import numpy as np
import torch

from codesign.batches import pool
from codesign.batches.pool import PoolScenes
from codesign.batches.scenes import TEST, EyeScenes, SceneConfig
from codesign.network import cost
from codesign.network.architecture import Architecture, SearchSpace
from codesign.network.supernet import recalibrate_batch_norm
from codesign.optics import stack as optics
from codesign.optics.stack import OpticsConfig
from codesign.train import assess, make_model
from codesign.train.trainer import InnerConfig, LearningRateSchedule, Trainer
from metalens.image.sensor import Sensor

# %% [markdown]
# ## Eyes
# A pool of frames is rendered once; gaze and lateral slippage are small, so that few steps of training show something.
# `slip_mm` is the label; `pool.light` is what a pinhole would see.

# %%
settings = SceneConfig(
    pixels=96, margin=16, slip_mm=(0.5, 0.5, 3.5), gaze_deg=(6.0, 5.0)
)
scenes = EyeScenes(settings, 9.0, 2000.0, seed=0)
frames = pool.render_pool(scenes, 768)
batches = PoolScenes(frames, settings.margin, settings.scale, seed=0)
figure, axes = plt.subplots(1, 5, figsize=(9, 2))
for image, panel in zip(frames.light, axes, strict=False):
    panel.imshow(image, cmap="gray")
    panel.set_axis_off()

# %% [markdown]
# ## What a network costs
# Multiply-accumulates are a smooth function of the pixel pitch (Eq. 9), so the pitch can be trained too.

# %%
space = SearchSpace(
    widths=(0.25, 0.5),
    depths=(2,),
    expansions=(3,),
    kernels=(5,),
    resolution=(1.0, 1.0),
)
member = Architecture((2,) * 5, (5,) * 10, (3,) * 10, 0.5, 1.0)
for pitch in (9.0, 12.0, 18.0):
    macs = cost.macs(member, pitch, window_um=96 * 9.0, space=space)
    print(f"pitch {pitch:.0f} um: {float(macs) / 1e6:.2f} MMACs")

# %% [markdown]
# ## Two lenses, equal training
# One keeps its focus at 33 mm, behind the eye, where blur grows one way with depth. The other starts there and moves:
# 20 polynomials of phase, with their own learning rate, from a tenth of the run to four fifths of it.

# %%
sensor = Sensor(9.0, 9.0, 4000.0, 0.0, 8000.0, 5.0, 10)


def train(polynomials, steps=200):
    # one PSF for the whole field: quick, and wrong by what `metalens codesign` prints of it
    lens = OpticsConfig(
        focus_mm=33.0, polynomials=polynomials, depth_count=14, image="uniform"
    )
    moving = LearningRateSchedule(0.03 if polynomials else 0.0, 0.1, 0.8)
    config = InnerConfig(
        steps=steps, batch=32, optics=moving, optics_weight=0.0, slip_weight=8.0
    )
    made = make_model(lens, pitch_um=9.0, seed=0, space=space)
    trainer = Trainer(config, lens, sensor, batches, made, architecture=member)
    losses = [record.task for record in trainer.run()]
    seen = assess.sensor_frames(trainer, batches, 6)
    recalibrate_batch_norm(made.net, member, seen.frames.split(seen.batch))
    return trainer, losses


runs = {"fixed": train(0), "joint": train(20)}
plt.figure(figsize=(5, 3))
for name, (_, losses) in runs.items():
    plt.plot(np.convolve(losses, np.ones(20) / 20, "valid"), label=name)
plt.xlabel("step")
plt.ylabel("task loss")
plt.legend()

# %% [markdown]
# ## What they reach, and whether they read the optics
# The last column moves the depth of the PSFs alone by 1 mm, geometry unchanged: a network that measures by blur follows,
# one that guesses from sizes answers 0. 200 steps are few (the study in `docs/codesign` takes 800 and five seeds): expect
# a first sign of life here, no ranking.

# %%
test = EyeScenes(settings, 9.0, 2000.0, seed=0, stream=TEST)
for name, (trainer, _) in runs.items():
    net = trainer.model.net
    seen, shifted = (
        assess.sensor_frames(trainer, test, 6, shift_um=um)
        for um in (0, assess.SHIFT_UM)
    )
    read, moved = (
        assess.predict_frames(net, member, frames, trainer.inner).slip_mm
        for frames in (seen, shifted)
    )
    error = (read - seen.slip_mm).abs().mean(0)
    response, _ = assess.depth_response(read[:, 2], moved[:, 2])
    print(
        f"{name}: axial {error[2]:.2f} mm, lateral {error[:2].mean():.2f} mm, {response:.2f} mm per mm of PSF depth"
    )

# %% [markdown]
# ## The lens that was found

# %%
trainer = runs["joint"][0]
found = trainer.model.coefficients_rad.detach()
figure, axes = plt.subplots(2, 5, figsize=(9, 3.8))
for row, phase in zip(axes, (0 * found, found), strict=True):
    stack = optics.lens_psf_stack(trainer.optics, phase)
    for panel, index in zip(row, np.linspace(0, 13, 5).astype(int), strict=True):
        panel.imshow(stack.intensity[index].clamp_min(0).sqrt(), cmap="magma")
        panel.set_title(f"{float(stack.depths_um[index]) * 1e-3:.0f} mm", fontsize=8)
        panel.set_axis_off()
print(
    "root-mean-square phase added:",
    round(float(torch.linalg.vector_norm(found)), 2),
    "rad",
)
