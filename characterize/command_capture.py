"""Virtual bench: lens.h5 and a hidden truth -> a capture folder (TIFF frames, stage.csv, dark, flat, capture.toml)."""

import shutil
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from characterize import bench, protocol
from characterize.bench import Shots, Truth
from characterize.protocol import Protocol
from characterize.slopes import slopes
from metalens import config, store
from metalens import lens as lenses
from metalens.commands import Common, Output
from metalens.errors import ConfigError
from metalens.lens import Lens


@dataclass(frozen=True)
class Options(Common):
    """Options of ``metalens capture``: either --truth or --protocol.

    Attributes:
        lens: the designed lens.
        output: folder of captures to write; with --protocol the stage.csv of the frames to take.
        truth: TOML of the hidden as-built lens and of its captures (depths_um, parameter, camera ...).
        protocol: TOML of what a real bench can do (depths_um, angles_deg, exposures, frames, peak_e ...): nothing is
            captured, the frames that tell most about the lens are listed, with the errors to expect.
    """

    lens: tyro.conf.Positional[Path]
    output: Output
    truth: Path | None = None
    protocol: Path | None = None


def run(options: Options) -> int:
    """Shoot and write, or plan; exit 0."""
    if (options.truth is None) == (options.protocol is None):
        raise ConfigError("give either --truth truth.toml (a virtual bench) or --protocol protocol.toml (a plan)")
    if options.protocol is not None:
        return _plan(options, options.protocol)
    return _shoot(options, options.truth or Path())


def _plan(options: Options, path: Path) -> int:
    target = options.claim(options.output)
    wanted, design = config.load(path, Protocol), lenses.load(options.lens)
    found = protocol.plan(design, wanted, slopes(design))
    lines = ["file,depth_um,angle_deg,exposure_s"]
    rows = list(zip(found.depth_um.tolist(), found.angle_deg.tolist(), found.exposure.tolist(), strict=True))
    lines += [f"frame_{i:03d}.tif,{z:.6g},{angle:.6g},{time:.6g}" for i, (z, angle, time) in enumerate(rows)]
    store.write_text(target, "\n".join(lines) + "\n")
    values = {"file": str(target), "frames": rows, "gain": found.gain.tolist()}
    values |= {"sigma": dict(zip(found.names, found.sigma.tolist(), strict=True))}
    values |= {"even_sigma": dict(zip(found.names, found.even_sigma.tolist(), strict=True))}
    told = [f"  {z:10.5g} um  {angle:6.3g} deg  exposure {time:g}" for z, angle, time in rows]
    table = zip(found.names, found.sigma, found.even_sigma, strict=True)
    told += [f"  {n:<24} +- {s:.2g}  (evenly spread: {even:.2g})" for n, s, even in table]
    options.console.result(values, "\n".join([f"{target}: {len(rows)} frames, the most telling first", *told]))
    return 0


def _shoot(options: Options, path: Path) -> int:
    target = options.output
    if target.exists() and not options.force:
        raise ConfigError(f"{target} exists; give --force to overwrite it")
    if target.exists() and not (target / "stage.csv").is_file():
        raise ConfigError(f"{target} is no capture folder (no stage.csv in it): not overwritten; give another name")
    if not target.parent.is_dir():
        raise ConfigError(f"{target}: folder {target.parent} does not exist")
    truth = config.load(path, Truth)
    design = lenses.load(options.lens)
    walls = any(k.name == "sidewall_deg" and k.value != 0 for k in truth.parameter)
    shots = bench.shoot(design, truth, slopes(design, sidewall=walls))
    write(target, shots, truth, design)
    values = {"folder": str(target), "frames": len(shots.frames), "peak_e": float(shots.electrons.max())}
    options.console.result(values, f"{target}: {len(shots.frames)} frames, peak {shots.electrons.max():.0f} electrons")
    return 0


def write(folder: Path, shots: Shots, truth: Truth, lens: Lens) -> None:
    """A capture folder as :func:`characterize.load` reads it, written beside and renamed: whole or not at all."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    try:
        part.mkdir()
        _fill(part, shots, truth, lens)
        if folder.exists():
            shutil.rmtree(folder)
        part.rename(folder)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def _fill(folder: Path, shots: Shots, truth: Truth, lens: Lens) -> None:
    import tifffile

    depths, angles = truth.stated
    lines = ["file,depth_um,angle_deg"]
    for i, (frame, z, angle) in enumerate(zip(shots.frames, depths, angles, strict=True)):
        name = f"frame_{i:03d}.tif"
        tifffile.imwrite(folder / name, frame, photometric="minisblack", metadata=None)
        lines.append(f"{name},{z:.10g},{np.degrees(angle[0]):.10g}")
    (folder / "stage.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name, stack in (("dark", shots.dark), ("flat", shots.flat)):
        tifffile.imwrite(folder / f"{name}.tif", stack, photometric="minisblack", metadata=None)
    about = {"pixel_um": truth.camera.pixel_um, "wavelength_um": lens.wavelength_um, "bits": truth.camera.bits}
    pinhole = [k.value for k in truth.parameter if k.name == "pinhole_um" and k.value > 0]
    about |= {"pinhole_um": pinhole[0]} if pinhole else {}
    text = "".join(f"{name} = {value!r}\n" for name, value in about.items())
    (folder / "capture.toml").write_text(text, encoding="utf-8")
