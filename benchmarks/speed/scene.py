"""Rendering and image formation: frames a second beside errors."""

import time

import torch

from benchmarks import Row, fastest
from benchmarks.peers import layered
from codesign.eye import population, renderer
from codesign.eye.population import CameraRig
from codesign.eye.renderer import PinholeCamera
from metalens.image import Grid, pupil, scene, uniform_imager
from metalens.image.pupil import Pupil
from metalens.psf import integrate_pixels
from tests.codesign.eye import model, plain_eye

NONE = float("nan")


def rows() -> list[Row]:
    """Rows of this topic."""
    import numba

    before = numba.get_num_threads(), torch.get_num_threads()
    out = []
    for threads in sorted({1, numba.config.NUMBA_NUM_THREADS}):
        numba.set_num_threads(threads)
        torch.set_num_threads(threads)
        out += [*_rendering(threads), *_imaging(threads), *_sensor(threads)]
    numba.set_num_threads(before[0])
    torch.set_num_threads(before[1])
    return out


def _twin_error(states: object, camera: PinholeCamera) -> float:
    few = states[:2]  # type: ignore[index]
    out = renderer.render(few, camera=camera)
    p = model.rows_of_camera(few, CameraRig(), camera)
    light, *_ = plain_eye.render_in_torch(p, CameraRig(), camera)
    return float((out.frames.radiance - light).norm() / light.norm())


def _rendering(threads: int) -> list[Row]:
    out = []
    for pixels, pitch, goal in ((160, 9.0, 800), (400, 3.6, 100)):
        camera = PinholeCamera(pixels, pitch)
        states = population.states_at(torch.arange(32), 1)
        seconds = fastest(
            lambda c=camera, s=states: renderer.render(s, camera=c), repeats=12
        ) / len(states)
        row = Row(
            f"frame {pixels}²", "compiled, with depth, masks, labels", seconds, _twin_error(states, camera),
            "float64 twin, relative L2", threads, goal=f"{1 / seconds:.0f}/s; asked {goal}/s",
        )  # fmt: skip
        out.append(row)
    return out


def _imaging(threads: int) -> list[Row]:
    states = population.states_at(torch.arange(8), 2)
    frames = renderer.render(states, camera=PinholeCamera()).frames
    depths = 1 / torch.linspace(1 / 32e3, 1 / 12e3, 21, dtype=torch.float64).flip(0)
    optics = Pupil(nodes=224)
    fine = pupil.psf(torch.zeros(224, 224, dtype=torch.float64), optics, depths_um=depths, focus_um=20e3,
                     sample_um=0.75, samples=372)  # fmt: skip
    stack = integrate_pixels(fine, 0.75, pitch_um=9.0, shape=(31, 31))
    stack = stack / stack.sum((1, 2), keepdim=True)
    layers = layered.cut_layers(frames, depths)
    order = [int((depths - d).abs().argmin()) for d in layers.depth_um]
    exact = layered.image_layers(layers, stack[order])[:, 16:144, 16:144]
    plain = fastest(lambda: layered.image_layers(layers, stack[order])) / 8
    start = time.perf_counter()
    grid = Grid((128, 128), 9.0, (12e3, 32e3), margin=16, window=31)
    made = uniform_imager(stack, depths, grid)
    prepare = time.perf_counter() - start
    image = made(frames)
    fast = fastest(lambda: made(frames), repeats=12) / 8
    error = float((image - exact).norm() / exact.norm())
    flat = scene.Frames(0.4 * frames.coverage, frames.coverage, frames.depth_um)
    constant = float((made(flat) - 0.4).abs().max() / 0.4)
    goal = f"{plain / fast:.1f} x plain; {1 / fast:.0f}/s; asked 5 x at 1e-3 and 400/s"
    kernels = f"{len(made.light.kernels)} kernels (made in {1e3 * prepare:.0f} ms; expected error {made.error:.1g})"
    against = "layer by layer, relative L2"
    return [
        Row(
            "image 128² of 21 depths",
            "plain: every layer by FFT",
            plain,
            NONE,
            "-",
            threads,
        ),
        Row(
            "image 128² of 21 depths", kernels, fast, error, against, threads, goal=goal
        ),
        Row(
            "constant radiance",
            "two sheets",
            fast,
            constant,
            "the constant",
            threads,
            goal="asked 1e-5",
        ),
    ]


def _sensor(threads: int) -> list[Row]:
    image = torch.rand(8, 640, 640)
    seconds = fastest(lambda: integrate_pixels(image, 1.0, pitch_um=3.7)) / 8
    kept = torch.nn.functional.pad(image.double(), (12, 12, 12, 12))
    error = abs(float(integrate_pixels(kept, 1.0, pitch_um=3.7).sum() / kept.sum()) - 1)
    return [
        Row(
            "640² samples on 3.7 um pixels",
            "exact overlap",
            seconds,
            error,
            "energy",
            threads,
        )
    ]
