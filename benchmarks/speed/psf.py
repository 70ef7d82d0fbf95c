"""PSF engine: time beside error for a 1 mm lens of 2500 x 2500 pillars; see
:mod:`benchmarks.speed._psf_case`.
"""

import functools
import math
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from benchmarks import Row, fastest
from benchmarks.peers import lowrank
from benchmarks.peers.angular_spectrum import angular_spectrum, free_space_transfer
from benchmarks.peers.radial import Radial, field_radial
from benchmarks.speed._psf_case import (
    DEPTHS,
    GEOMETRY,
    PITCH,
    RADIUS,
    SOURCE,
    WAVELENGTH,
    WINDOW,
    D,
    K,
    error,
    exact,
    forward,
    gradient,
    gradient_error,
    lens,
    peak_mb,
    textbook,
)
from metalens import propagate, psf
from metalens.propagate.estimate import draw_pixels, sampled_square_error

WIDE = dict(
    window_um=128.0, samples=64, integrate=False
)  # samples 2 um apart, as the exact sum gives them
CELLS = WIDE | dict(integrate=True)  # the light of pixels of 2 um
SIZES = (
    (0.25, 21),
    (0.5, 21),
    (1.0, 21),
    (2.0, 21),
    (4.0, 21),
    (1.0, 51),
    (1.0, 101),
    (1.0, 201),
    (1.0, 401),
    (4.0, 401),
)
KINDS = (
    "hyperbolic",
    "noisy",
    "double helix",
)  # beside the free-form lens of the main rows


def rows() -> list[Row]:
    """All rows of the engine: against the textbook, ladder, depths, angles, lenses,
    polarisations, sizes, low rank,
    Hankel."""
    return [
        *_main_rows(),
        *_ladder_rows(),
        *_lens_rows(),
        *polarised_rows(),
        *_size_rows(),
        *_other_rows(),
    ]


def _main_rows() -> list[Row]:
    """The asked case on a free-form lens: windowed first, on a machine that nothing
    else has warmed or filled.
    """
    maps, threads = lens("free-form"), torch.get_num_threads()
    start = time.perf_counter()
    stack = forward(maps)
    cold = time.perf_counter() - start
    start = time.perf_counter()
    forward(maps, window_um=47.0)
    first = time.perf_counter() - start
    once, both = (
        fastest(lambda: forward(maps), repeats=15),
        fastest(lambda: gradient(maps), repeats=15),
    )
    memory = peak_mb(lambda: forward(maps)), peak_mb(lambda: gradient(maps))
    case = propagate.make_case(
        maps[0].shape, **GEOMETRY, depths_um=DEPTHS[10], **WINDOW
    )
    h = torch.tensor(free_space_transfer(case, (5000, 5000)).astype("c8"))
    slow = [
        fastest(lambda g=g: textbook(maps, h, grad=g), repeats=2) * len(DEPTHS)
        for g in (False, True)
    ]
    size = maps[0].numel() * 4 / 2**20
    case_name = "1 mm free-form, 21 depths"
    wrong = error(stack, maps)
    about = f"exact sum (estimate {stack.error:.1e})"
    goals = (
        f"{slow[0] / once:.0f}x textbook (300x, goal 600x), 1e-4, 150 MB",
        f"{slow[1] / both:.0f}x textbook (250x, goal 800x), 2e-4, 250 MB",
    )
    judged = "gradient in float64 at 1e-9"
    planned = f"{slow[0] / first:.0f}x textbook (300x), with the plan"
    return [
        Row(
            case_name, "windowed 1e-4", once, wrong, about, threads, memory[0], goals[0]
        ),
        Row(
            case_name,
            "windowed 1e-4, first call of the geometry",
            first,
            wrong,
            about,
            threads,
            goal=planned,
        ),
        Row(
            case_name,
            "windowed 1e-4, first call of the process",
            cold,
            wrong,
            about,
            threads,
            goal="code is read",
        ),
        Row(
            case_name,
            "windowed 1e-4, with gradient",
            both,
            gradient_error(maps, 1e-4),
            judged,
            threads,
            memory[1] - size,
            goals[1],
        ),
        Row(
            case_name,
            "textbook angular spectrum, complex64",
            slow[0],
            _lattice_error(maps),
            "exact sum",
            threads,
        ),
        Row(case_name, "textbook, with gradient", slow[1], math.nan, "none", threads),
    ]


def _lattice_error(maps: Any) -> float:
    """Error of the textbook method on a 16 x 16 window of the lattice, one depth."""
    geometry = GEOMETRY | dict(
        depths_um=DEPTHS[10],
        window_um=16 * 2 * PITCH,
        samples=16,
        offset_um=(PITCH / 2, PITCH / 2),
    )
    arrays = maps[0].numpy(), maps[1].numpy()
    got = np.abs(angular_spectrum(*arrays, single=True, **geometry)) ** 2
    want = np.abs(propagate.exact(*arrays, **geometry)) ** 2
    return float(
        np.linalg.norm(got / got.sum() - want / want.sum())
        / np.linalg.norm(want / want.sum())
    )


def _ladder_rows() -> list[Row]:
    maps, threads = lens("hyperbolic"), torch.get_num_threads()
    base = fastest(lambda: forward(maps))
    found = []
    for tolerance, dtype, goal in (
        (1e-6, torch.float32, "2.5x of 1e-4"),
        (1e-9, torch.float64, "1e-9"),
    ):
        cast = tuple(m.to(dtype) for m in maps)
        stack = forward(cast, tolerance=tolerance)
        seconds = fastest(lambda c=cast, t=tolerance: forward(c, tolerance=t))
        reached = f"{seconds / base:.2f}x of 1e-4 ({goal}), estimate {stack.error:.1e}"
        name = f"windowed {tolerance:.0e} {str(dtype)[6:]}"
        found.append(
            Row(
                "1 mm, 21 depths",
                name,
                seconds,
                error(stack, cast),
                "exact sum",
                threads,
                goal=reached,
            )
        )
    depths = np.linspace(16e3, 26e3, 201)
    seconds, stack = (
        fastest(lambda: forward(maps, depths_um=depths)),
        forward(maps, depths_um=depths),
    )
    goal = f"{seconds / base:.2f}x of 21 depths (2.5x)"
    found.append(
        Row(
            "1 mm, 201 depths",
            "windowed 1e-4",
            seconds,
            error(stack, maps),
            "exact sum",
            threads,
            goal=goal,
        )
    )
    return [*found, *_angle_rows(maps, threads)]


def _angle_rows(maps: Any, threads: int) -> list[Row]:
    one = fastest(lambda: forward(maps, **WIDE))
    angles = [[math.radians(a), 0.0] for a in (0, 5, 10, 15, 20)]
    stack = forward(maps, angle_rad=angles, **WIDE)
    seconds = fastest(lambda: forward(maps, angle_rad=angles, **WIDE))
    worst = max(error(stack, maps, row) for row in range(5))
    narrow = fastest(lambda: forward(maps))
    goal = f"{seconds / one:.1f}x one angle of this window, {seconds / narrow:.1f}x of the 48 um window (7x)"
    return [
        Row(
            "1 mm, 21 depths, 128 um window",
            "windowed 1e-4, 0 deg",
            one,
            error(forward(maps, **WIDE), maps),
            "exact sum",
            threads,
        ),
        Row(
            "1 mm, 21 depths, 128 um window",
            "windowed 1e-4, 5 angles to 20 deg",
            seconds,
            worst,
            "exact sum, worst angle",
            threads,
            goal=goal,
        ),
        _cells_row(maps, threads, one),
    ]


def _cells_row(maps: Any, threads: int, samples_s: float) -> Row:
    """Pixels wider than Nyquist's step, whose light is integrated; against a window of
    pixels half as wide.
    """
    stack, seconds = forward(maps, **CELLS), fastest(lambda: forward(maps, **CELLS))
    finer = forward(maps, window_um=128.0, samples=128).intensity
    light = finer.reshape(*finer.shape[:-2], 64, 2, 64, 2).sum((-3, -1))
    wrong = float(
        (light / light.sum((-2, -1), keepdims=True) - stack.intensity).norm()
        / stack.intensity.norm()
    )
    goal = f"{seconds / samples_s:.1f}x of samples, estimate {stack.error:.1e}"
    about = "sums over pixels of 1 um"
    return Row(
        "1 mm, 21 depths, pixels of 2 um",
        "windowed 1e-4",
        seconds,
        wrong,
        about,
        threads,
        goal=goal,
    )


def _lens_rows() -> list[Row]:
    threads, found = torch.get_num_threads(), []
    for kind in KINDS:
        maps = lens(kind)
        stack = forward(maps)
        seconds = fastest(lambda m=maps: forward(m))
        about = f"exact sum (estimate {stack.error:.1e})"
        wrong = f"gradient error {gradient_error(maps, 1e-4):.1e} (2e-4)"
        name = f"1 mm {kind}, 21 depths"
        found.append(
            Row(
                name,
                "windowed 1e-4",
                seconds,
                error(stack, maps),
                about,
                threads,
                goal=wrong,
            )
        )
    return found


def polarised_rows() -> list[Row]:
    """One scalar, |E|² and the flux of both polarisations: processor time beside the
    error of the middle depth.
    """
    threads, maps = torch.get_num_threads(), lens("hyperbolic")
    base, found = math.nan, []
    for kind in ("scalar", "vector", "flux"):
        stack, seconds = (
            forward(maps, polarisation=kind),
            fastest(lambda k=kind: forward(maps, polarisation=k)),
        )
        base = seconds if kind == "scalar" else base
        about = f"sums of E and H (estimate {stack.error:.1e})"
        goal = f"{seconds / base:.1f}x of the scalar"
        name = f"1 mm, 21 depths, {kind}"
        found.append(
            Row(
                name,
                "windowed 1e-4",
                seconds,
                _polarised_error(stack, maps, kind),
                about,
                threads,
                goal=goal,
            )
        )
    return found


def _polarised_error(
    stack: psf.PsfStack, maps: tuple[torch.Tensor, torch.Tensor], kind: str
) -> float:
    """Relative L2 at the middle depth against E and H of every pillar summed apart, at
    drawn points of the window.
    """
    plain, depth = stack.numpy(), len(stack.depths_um) // 2
    flat = np.asarray(plain.intensity[depth], float).reshape(1, -1)
    points, chance = draw_pixels(flat[0], 64)
    y, x = np.divmod(points, len(plain.x_um))
    where = np.stack([plain.x_um[x], plain.y_um[y]], -1)
    one = {
        "depths_um": plain.depths_um[depth],
        "window_um": plain.step_um,
        "samples": 1,
    }
    case = propagate.make_case(maps[0].shape, **GEOMETRY, **one)

    def at(factor: np.ndarray | float) -> np.ndarray:
        return propagate.field_at(
            maps[0].numpy(), maps[1].numpy() * factor, case, where
        )[0]

    want = np.abs(at(1.0)) ** 2 if kind == "scalar" else _from_fields(at, case, kind)
    difference = (
        want * plain.step_um**2 / float(plain.energy_um2[depth]) - flat[:, points]
    )
    square = sampled_square_error(flat[:, points], chance, difference)
    return math.sqrt(square / (flat**2).sum())


def _from_fields(
    at: Callable[[np.ndarray], np.ndarray], case: propagate.PropagationCase, kind: str
) -> np.ndarray:
    """Ex Hy* - Ey Hx* or |E|² of both polarisations, each ray turned from the axis to
    the middle of the window.
    """
    y, x = case.pillars_um
    r = np.sqrt(x**2 + y[:, None] ** 2 + D**2)
    bx, by, bz = -x / r, -y[:, None] / r, D / r
    along = np.array([1 - bx * bx / (1 + bz), -bx * by / (1 + bz), -bx]) / np.sqrt(bz)
    across = np.array([-bx * by / (1 + bz), 1 - by * by / (1 + bz), -by]) / np.sqrt(bz)
    e, h = (
        np.array([at(part) for part in field]) for field in (along, across)
    )  # H of light along x is E along y
    if kind == "flux":
        return np.asarray((e[0] * h[1].conj() - e[1] * h[0].conj()).real)
    return np.asarray(((np.abs(e) ** 2).sum(0) + (np.abs(h) ** 2).sum(0)) / 2)


def _size_rows() -> list[Row]:
    threads, found = torch.get_num_threads(), []
    for millimetres, depths in SIZES:
        maps = lens("hyperbolic", round(millimetres * 1000 / PITCH))
        arguments: dict[str, Any] = dict(
            depths_um=np.linspace(16e3, 26e3, depths), integrate=False
        )
        stack = forward(maps, **arguments)
        seconds = fastest(lambda m=maps, a=arguments: forward(m, **a))
        memory = peak_mb(lambda m=maps, a=arguments: forward(m, **a))
        name = f"{millimetres:g} mm, {depths} depths"
        found.append(
            Row(
                name,
                "windowed 1e-4",
                seconds,
                stack.error,
                "own estimate",
                threads,
                memory,
            )
        )
    return found


def _other_rows() -> list[Row]:
    threads, maps = torch.get_num_threads(), lens("hyperbolic")
    stack = forward(maps, depths_um=np.linspace(16e3, 26e3, 51))
    small = lowrank.compress(stack, tolerance=1e-3)
    seconds = fastest(lambda: lowrank.compress(stack, tolerance=1e-3))
    round_lens = Radial(
        lambda r: (
            -K * (r * r / (np.hypot(r, D) + D) + r * r / (np.hypot(r, SOURCE) + SOURCE))
        ),
        np.ones_like,
        RADIUS,
    )
    case = propagate.make_case(maps[0].shape, **GEOMETRY, depths_um=DEPTHS, **WINDOW)
    hankel = field_radial(round_lens, case, 1e-4)
    light = np.abs(hankel.field) ** 2
    energy = light.sum((1, 2))
    as_stack = replace(
        forward(maps),
        intensity=light / energy[:, None, None],
        energy_um2=energy * stack.step_um**2,
    )
    return [
        Row(
            "51 depths of 64 x 64",
            f"low rank 1e-3: {small.rank} basis PSFs",
            seconds,
            float(small.errors.max()),
            "the stack",
            threads,
        ),
        Row(
            "1 mm, 21 depths",
            "Hankel 1e-4",
            fastest(lambda: field_radial(round_lens, case, 1e-4)),
            error(as_stack, maps),
            f"exact sum of the pixelated lens (estimate {hankel.error:.1e})",
            threads,
        ),
    ]


def peer_rows() -> list[Row]:
    """torchoptics' direct integration, one depth times 21, in an environment that holds
    it; none elsewhere.
    """
    try:
        from torchoptics import Field
    except ImportError:
        return []
    maps, threads = lens("hyperbolic"), torch.get_num_threads()
    x = (torch.arange(2500, dtype=torch.float64) - 1249.5) * PITCH
    z = DEPTHS[10]
    r2 = x**2 + x[:, None] ** 2
    source = r2 / ((r2 + z * z).sqrt() + z)
    light = torch.polar(maps[1].double(), maps[0].double() + K * source).to(
        torch.complex64
    )
    metre = 1e-6
    field = Field(light, wavelength=WAVELENGTH * metre, z=0.0, spacing=PITCH * metre)
    go = functools.partial(
        field.propagate, 64, D * metre, spacing=0.75 * metre, propagation_method="DIM"
    )
    seconds = fastest(go, repeats=1) * len(DEPTHS)
    power = go().data.abs().double().numpy() ** 2
    ours = fastest(lambda: forward(maps), repeats=5)
    stack = forward(maps, depths_um=DEPTHS[10:11])
    points = np.arange(64 * 64).reshape(64, 64)[2::6, 2::6].ravel()
    want = exact(maps, stack, (0, 0), points)
    got = power.ravel()[points]
    wrong = float(
        np.linalg.norm(got / got.sum() - want / want.sum())
        / np.linalg.norm(want / want.sum())
    )
    return [
        Row(
            "1 mm, 21 depths",
            "torchoptics direct integration",
            seconds,
            wrong,
            "exact sum",
            threads,
        ),
        Row(
            "1 mm, 21 depths",
            "windowed 1e-4",
            ours,
            stack.error,
            "own estimate",
            threads,
            goal=f"{seconds / ours:.0f}x (700x)",
        ),
    ]
