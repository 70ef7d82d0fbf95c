"""Outputs of the golden chain: name, value, error bar, and the value of a plain sum.

``python -m tests.golden.outputs`` rewrites ``golden.json``; a value may move by more
than its bar only where the physics or the settings of ``tests/small.py`` change.
"""

import json
import tempfile
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from metalens import cell as cells
from metalens import image, lens, library, modal, psf, rcwa
from tests import small
from tests.golden import plain_sums as plain
from tests.referees import plain_exposure

STORED = Path(__file__).with_name("golden.json")
WAVE = small.WAVELENGTH_UM
BEHIND = ((1.0, small.AIR_UM), (small.GLASS_N, small.GLASS_UM))
REDUCED_UM = small.AIR_UM + small.GLASS_UM / small.GLASS_N
DIAMETERS_UM = (0.09, 0.14, 0.19)


class Output(NamedTuple):
    """value of the toolchain, its error bar, and the same by other means."""

    name: str
    value: float
    bar: float
    judge: float


def cell() -> cells.Cell:
    return cells.Cell(
        pitch_um=small.PITCH_UM,
        height_um=small.HEIGHT_UM,
        pillar=cells.Index(3.6),
        substrate=cells.Index(small.SUBSTRATE_N),
    )


@cache
def solved(diameter_um: float) -> complex:
    return modal.solve(cell(), diameter_um, WAVE, tolerance=3e-4).t


def of_cell() -> Iterator[Output]:
    """Coupled waves, whose own error bar is judged, and the modal method to 3e-4."""
    for d in DIAMETERS_UM:
        one = rcwa.solve(cell(), d, WAVE, tolerance=1e-3)
        yield Output(f"t.real {d}", one.t.real, one.t_error + 3e-4, solved(d).real)
        yield Output(f"t.imag {d}", one.t.imag, one.t_error + 3e-4, solved(d).imag)
        yield Output(f"energy {d}", one.energy, 1e-9, 1.0)  # lossless, one order


def of_library(path: Path) -> Iterator[Output]:
    """The proxy beside single solves: 1e-3 of an entry, 1e-3 of the fit."""
    made = library.load(path)
    for d in DIAMETERS_UM:
        t = made.proxy.transmission(d, WAVE) * np.exp(
            1j * made.proxy.phase_rad(d, WAVE)
        )
        yield Output(f"proxy.real {d}", float(t.real), 2e-3, solved(d).real)
        yield Output(f"proxy.imag {d}", float(t.imag), 2e-3, solved(d).imag)


class Pillars(NamedTuple):
    """(n,) places, diameters and transmissions of the pillars of a lens file."""

    x: np.ndarray
    y: np.ndarray
    diameter: np.ndarray
    t: np.ndarray


def pillars(path: Path, wider_um: float = 0.0) -> Pillars:
    made = lens.load(path)
    rows, columns = np.nonzero(made.diameters.diameter_um)
    d = made.diameters.diameter_um[rows, columns].astype(float)
    t = made.proxy.transmission(d + wider_um, WAVE)
    t = t * np.exp(1j * made.proxy.phase_rad(d + wider_um, WAVE))
    return Pillars(made.diameters.x_um[columns], made.diameters.y_um[rows], d, t)


def front(depth_um: float) -> tuple[tuple[float, float], ...]:
    substrate = (small.SUBSTRATE_N, small.SUBSTRATE_UM)
    return (1.0, depth_um - small.SUBSTRATE_UM), substrate


def of_lens(path: Path) -> Iterator[Output]:
    """Sites by the rule (centre half a pitch inside the rim); phases by Snell's law."""
    p = pillars(path)
    u = (np.arange(small.SITES) - (small.SITES - 1) / 2) * small.PITCH_UM
    inside = np.hypot(u, u[:, None]) <= (small.SITES - 1) / 2 * small.PITCH_UM
    yield Output("pillars", len(p.x), 0, inside.sum())
    r = np.hypot(p.x, p.y)
    optical = plain.ray_path(BEHIND, 13.0)(r) + plain.ray_path(
        front(small.SOURCE_UM), 13.0
    )(r)
    place = np.rint(np.stack([p.y, p.x]) / small.PITCH_UM + (small.SITES - 1) / 2)
    added = small.map_rad()[tuple(place.astype(int))]
    error = np.angle(p.t * np.exp(1j * (2 * np.pi / WAVE * optical - added)))
    strehl = abs(np.exp(1j * error).mean()) ** 2
    yield Output("strehl of the phases", strehl, 1e-6, 1.0)
    # float32 diameters and a proxy of 1e-3: sums over 4872 pillars move by 1e-4
    for name, value in (("mean", p.diameter), ("x moment", p.diameter * p.x),
                        ("y moment", p.diameter * p.y)):  # fmt: skip
        yield Output(f"diameter, {name}", value.mean(), 5e-4, _wanted(path, p, name))


def _wanted(path: Path, p: Pillars, name: str) -> float:
    """The same moment of diameters that a table of the proxy gives for the phases."""
    made = lens.load(path)
    table = np.linspace(p.diameter.min(), p.diameter.max(), 40001)
    phase = np.unwrap(made.proxy.phase_rad(table, WAVE))
    target = np.angle(p.t)
    turn = np.ceil((phase[0] - target - 1e-9) / (2 * np.pi))
    d = np.interp(target + 2 * np.pi * turn, phase, table)
    weight = {"mean": 1.0, "x moment": p.x, "y moment": p.y}[name]
    return float((d * weight).mean())


def of_stack(lens_path: Path, path: Path) -> Iterator[Output]:
    """Intensities to the stack's tolerance of 1e-4, energy to the angle of the faces."""
    stack, p = psf.load(path), pillars(lens_path)
    kernel = plain.kernel_table(BEHIND, WAVE, 36.0)
    face = plain.normal_transmission((1.0, small.GLASS_N))
    for a, angle in enumerate(stack.angles_rad):
        x = stack.centres_um[a][0] + stack.x_um
        y = stack.centres_um[a][1] + stack.y_um
        lights = np.stack([p.t * plain.source_wave(p.x, p.y, front(z), np.tan(angle), WAVE)
                           for z in stack.depths_um], -1)  # fmt: skip
        true = (
            np.abs(plain.fields(p.x, p.y, lights, kernel, small.PITCH_UM**2, x, y)) ** 2
        )
        for z, depth in enumerate(stack.depths_um):
            where = f"{np.degrees(angle[0]):.0f} deg {depth:.0f} um"
            mine, other = stack.intensity[a, z], true[z] / true[z].sum()
            error = np.linalg.norm(mine - other) / np.linalg.norm(other)
            yield Output(f"psf error, {where}", error, 1e-4, 0.0)
            yield Output(
                f"psf peak, {where}", mine.max(), 2e-4 * mine.max(), other.max()
            )
            energy = true[z].sum() * stack.step_um**2 * face
            yield Output(
                f"psf energy um2, {where}",
                stack.energy_um2[a, z],
                1e-3 * energy,
                energy,
            )
            found, judge = (plain.moments(one, x, y) for one in (mine, other))
            for k, word in enumerate(("x", "y", "xx", "yy", "xy")):
                # a picture of relative L2 error e moves a moment by at most e times the
                # r.m.s. of its weight over the window: 4 um, 20 um2; in fact a tenth
                bar = 4e-4 if k < 2 else 2e-3
                yield Output(f"psf {word}, {where}", found[k], bar, judge[k])


def of_mask(lens_path: Path, folder: Path) -> Iterator[Output]:
    """Shapes as KLayout reads them beside the lens file: polygons of equal area, classes
    of 2 nm, a grid of 1 nm."""
    import klayout.db as db

    p = pillars(lens_path)
    goal = plain.drawn_diameter_nm(p.diameter * 1e3, small.BIAS_TABLE_NM) * 1e-3
    area = np.pi / 4 * (goal**2).sum()
    mean = np.pi / 4 * (goal**2).mean()
    for name in ("mask.oas", "mask.gds"):
        drawn = db.Layout()
        drawn.read(str(folder / name))
        region = db.Region()
        for index in drawn.layer_indexes():
            if drawn.get_info(index).layer == 1:
                region += db.Region(drawn.top_cell().begin_shapes_rec(index))
        region.merged_semantics = False
        yield Output(f"{name}: pillars", region.count(), 0, len(p.x))
        # rounding to classes of 2 nm: 0.58 nm a pillar, averaged over 4872 pillars
        bar = area * (2 * 0.58e-3 / np.sqrt(mean) / np.sqrt(len(p.x)) * 3 + 1e-3)
        yield Output(f"{name}: um2", region.area() * drawn.dbu**2, bar, area)
        box = region.bbox()
        wide = [np.ptp(one) + goal.mean() for one in (p.x, p.y)]
        yield Output(f"{name}: width um", box.width() * drawn.dbu, 0.15, wide[0])
        yield Output(f"{name}: height um", box.height() * drawn.dbu, 0.15, wide[1])


def of_exposure(folder: Path) -> Iterator[Output]:
    """Dose to size at the edges of six pillars, by plain convolution: 1 % asked for,
    0.3 % of pixels; 1 nm of diameter.
    """
    drawn = plain_exposure.shapes(folder / "mask.gds", folder / "doses.csv", (10, 2, 7))
    terms = [(small.BEAM["alpha_um"], 1.0), (small.BEAM["beta_um"], small.BEAM["eta"])]
    resist = plain_exposure.Resist(drawn, terms)
    places = np.array([shape.middle for shape in drawn if shape.layer == 1])
    own = np.flatnonzero([shape.layer == 1 for shape in drawn])
    middle = (places.min(0) + places.max(0)) / 2
    for dx, dy in ((0, 0), (11.0, 1.0), (-7.9, 7.7), (3.1, -11.2), (-4.0, -2.0)):
        k = own[np.hypot(*(places - middle - (dx, dy)).T).argmin()]
        edge, made = resist.pillar(int(k), small.BEAM["alpha_um"] / 4)
        yield Output(f"exposure at {dx}, {dy}", edge, 0.013, 1.0)
        yield Output(f"diameter at {dx}, {dy}", made, 1.1e-3, drawn[k].diameter_um)


def bench(p: Pillars, shift: np.ndarray) -> np.ndarray:
    """(depth, y, x) light in the pixels of the bench, in units of its own.

    Args:
        shift: of the distance in um, coma in rad (Noll's Z8 over the outermost centre),
            centre x and y in um, stage in um.
    """
    distance, coma, cx, cy, stage = shift
    rim = np.hypot(p.x, p.y).max()
    u, v = p.x / rim, p.y / rim
    t = p.t * np.exp(1j * coma * np.sqrt(8) * (3 * (u * u + v * v) - 2) * u)
    behind = ((1.0, small.AIR_UM + distance), BEHIND[1])
    kernel = plain.kernel_table(behind, WAVE, 32.0)
    depths = np.array(small.DEPTHS_UM) + stage
    lights = np.stack([t * plain.source_wave(p.x, p.y, front(z), (0.0, 0.0), WAVE)
                       for z in depths], -1)  # fmt: skip
    x, weight = plain.pixel_nodes(small.PIXELS, small.PIXEL_UM, cx)
    y, _ = plain.pixel_nodes(small.PIXELS, small.PIXEL_UM, cy)
    field = plain.fields(p.x, p.y, lights, kernel, small.PITCH_UM**2, x, y)
    apparent = depths - small.SUBSTRATE_UM * (1 - 1 / small.SUBSTRATE_N)
    return plain.on_pixels(np.abs(field) ** 2, weight) / apparent[:, None, None] ** 2


@cache
def _true_frames(lens_path: Path) -> np.ndarray:
    """Electrons of the hidden lens, without noise."""
    hidden = small.HIDDEN
    p = pillars(lens_path, hidden["bias_nm"] * 1e-3)
    light = bench(p, np.array([hidden["distance_um"], hidden["coma_x_rad"], 0, 0, 0]))
    return light * small.PEAK_E / light.max()


def of_captures(lens_path: Path, folder: Path) -> Iterator[Output]:
    """Frames beside the plain sum of the hidden lens, by own Poisson statistics."""
    import tifffile

    frames = np.stack(
        [tifffile.imread(one) for one in sorted(folder.glob("frame_*.tif"))]
    )
    dark = tifffile.imread(folder / "dark.tif").astype(float)
    read2 = small.READ_E**2 / small.GAIN_E**2 + 1 / 12  # counts2, with rounding
    yield Output(
        "dark, mean", dark.mean(), 4 * np.sqrt(read2 / dark.size), small.OFFSET
    )
    spread = 4 * read2 * np.sqrt(2 / dark.size)
    yield Output("dark, variance", dark.var(), spread, read2)
    electrons = _true_frames(lens_path)
    expected = electrons / small.GAIN_E + small.OFFSET
    variance = electrons / small.GAIN_E**2 + read2
    for one, mine, true, noise in zip(
        small.DEPTHS_UM, frames, expected, variance, strict=True
    ):
        bar = 4 * np.sqrt(noise.sum()) + 1e-3 * (true - small.OFFSET).sum()
        yield Output(f"frame at {one:.0f} um, counts", mine.sum(), bar, true.sum())
    chi2 = ((frames - expected) ** 2 / variance).mean()
    yield Output("frames, chi2", chi2, 4 * np.sqrt(2 / frames.size), 1.0)


def of_fit(lens_path: Path, path: Path) -> Iterator[Output]:
    """The hidden values, within four of the Cramer-Rao bounds of a plain model."""
    import characterize

    made = characterize.AsBuilt.load(path)
    base, step = pillars(lens_path), 1e-3
    wider = pillars(lens_path, step)
    electrons = _true_frames(lens_path)

    @cache
    def lit(bias_nm: float, *shift: float) -> np.ndarray:
        t = base.t * (wider.t / base.t) ** (bias_nm * 1e-3 / step)
        return bench(base._replace(t=t), np.array(shift))

    def predict(q: np.ndarray) -> np.ndarray:
        return np.exp(q[6]) * lit(*q[:6].tolist()) + q[7]

    light = lit(*[0.0] * 6)
    place = np.array([0.0, 0, 0, 0, 0, 0, np.log(small.PEAK_E / light.max()), 0.0])
    steps = np.array([0.5, 0.3, 0.02, 0.05, 0.05, 3.0, 0.01, 1.0])
    sigma = plain.fisher_sigma(predict, place, steps, electrons + small.READ_E**2)
    for k, name in enumerate(("bias_nm", "distance_um", "coma_x_rad")):
        value = float(made.value[made.names.index(name)])
        yield Output(f"{name}", value, 4 * sigma[k], small.HIDDEN[name])
        low, high = made.within_model(name)
        # differences about the design, not the hidden lens: a fifth
        yield Output(
            f"{name}, half interval",
            (high - low) / 2,
            0.25 * 1.96 * sigma[k],
            1.96 * sigma[k],
        )


def of_image(lens_path: Path, tilt: float) -> Iterator[Output]:
    """A textured plane, even or leaning, beside one plain sum a source point.

    Bar: the image's own error, of a 1/f texture, twice for a texture that is white.
    """
    step, count, margin, window = 1.1, 12, 8, 17
    grid = image.Grid(samples=(count, count), step_um=step, depths_um=(450.0, 900.0),
                      margin=margin, window=window)  # fmt: skip
    camera = image.imager(lens.load(lens_path), grid, tolerance=2e-2)
    side = count + 2 * margin
    axis = (np.arange(side) - (side - 1) / 2) * step
    radiance = np.random.default_rng(5).random((side, side)) ** 4
    depth = np.full((side, side), 600.0) + tilt * axis
    sheets = (np.stack([0 * radiance, radiance]), np.stack([0 * radiance, 0 * radiance + 1]),
              np.stack([depth, depth]))  # fmt: skip
    frames = image.Frames(*(torch.as_tensor(one[None]) for one in sheets))
    mine = np.asarray(camera(frames))[0]
    true = _plain_image(
        pillars(lens_path),
        axis,
        radiance,
        depth,
        slice(margin, margin + count),
        step * window,
    )
    scale = (mine * true).sum() / (true**2).sum()
    bar = 2 * camera.error
    error = np.linalg.norm(mine - scale * true) / np.linalg.norm(mine)
    yield Output(f"image error, tilt {tilt}", error, bar, 0.0)
    for i, j in ((2, 3), (7, 9), (10, 1), (5, 5)):
        yield Output(
            f"image [{i}, {j}], tilt {tilt}",
            mine[i, j],
            2 * bar * mine[i, j],
            scale * true[i, j],
        )


def _plain_image(p, axis, radiance, depth, inner, window_um) -> np.ndarray:
    """(y, x) light in the pixels: every source point through every pillar."""
    step = axis[1] - axis[0]
    nodes, weight = plain.pixel_nodes(len(axis[inner]), step, 0.0, points=2)
    kernel = plain.kernel_table(BEHIND, WAVE, 45.0)
    total = np.zeros((len(nodes), len(nodes)))
    for i, v in enumerate(axis):
        waves = [p.t * plain.source_wave(p.x, p.y, front(depth[i, j]), np.array([u, v]) / REDUCED_UM, WAVE)
                 for j, u in enumerate(axis)]  # fmt: skip
        near = abs(nodes - v) <= window_um / 2
        light = (
            np.abs(
                plain.fields(
                    p.x,
                    p.y,
                    np.stack(waves, -1),
                    kernel,
                    small.PITCH_UM**2,
                    nodes,
                    nodes[near],
                )
            )
            ** 2
        )
        light *= abs(nodes - axis[:, None])[:, None] <= window_um / 2
        total[near] += np.tensordot(radiance[i], light, 1)
    return plain.on_pixels(total, weight)


def of_training(folder: Path) -> Iterator[Output]:
    """Steps that were logged, losses that are finite; the counted operations."""
    rows = [json.loads(one) for one in (folder / "log.jsonl").read_text().splitlines()]
    losses = [row["loss"] for row in rows if row["kind"] == "step"]
    yield Output("steps", len(losses), 0, 3)
    yield Output(
        "finite losses", bool(np.isfinite(losses).all() and min(losses) > 0), 0, 1
    )


GROUPS = {
    "cell": (of_cell,), "library": (of_library, "library.h5"), "lens": (of_lens, "lens.h5"),
    "stack": (of_stack, "lens.h5", "psf.h5"), "mask": (of_mask, "lens.h5", "mask"),
    "exposure": (of_exposure, "mask"), "captures": (of_captures, "lens.h5", "captures"),
    "fit": (of_fit, "lens.h5", "asbuilt.h5"),
    "even image": (partial(of_image, tilt=0.0), "lens.h5"),
    "leaning image": (partial(of_image, tilt=7.0), "lens.h5"),
    "training": (of_training, "run"),
}  # fmt: skip


def outputs(group: str, chain: small.Chain) -> list[Output]:
    """Outputs of a group from the files of the chain."""
    function, *names = GROUPS[group]
    return list(function(*(chain[name] for name in names)))


def main() -> None:
    """Make the chain anew and store its outputs with their bars."""
    with tempfile.TemporaryDirectory() as name:
        chain = small.Chain(Path(name))
        found = {
            group: {
                one.name: [float(f"{one.value:.8g}"), float(f"{one.bar:.3g}")]
                for one in outputs(group, chain)
            }
            for group in GROUPS
        }
    STORED.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
