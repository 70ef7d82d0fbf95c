"""Virtual bench: lens.h5 and a hidden truth -> a capture folder (TIFF frames,
stage.csv, dark, flat, capture.toml).
"""

from pathlib import Path

import numpy as np

from characterize.bench import (
    BenchProtocol,
    HiddenLens,
    SimulatedFrames,
    bench,
    protocol,
)
from characterize.commands.capture_options import Options
from characterize.inference import REACH
from characterize.model import log_response_slopes
from metalens import lens as lenses
from metalens.core import config, store
from metalens.core.errors import ConfigError
from metalens.lens import Lens

_STATED = ("pinhole_um", "glass_um", "glass_tilt_x_deg", "glass_tilt_y_deg")


def run(options: Options) -> int:
    """Simulate captures and write them, or plan them; exit 0.

    Args:
        options: options of the command.
    """
    if options.truth is not None and options.protocol is None:
        return _simulate(options, options.truth)
    if options.protocol is None or options.truth is not None:
        raise ConfigError(
            "give either --truth truth.toml (a virtual bench) or --protocol "
            "protocol.toml (a plan)"
        )
    if options.workers is not None:
        raise ConfigError(
            "--workers shares out the frames of --truth; a plan takes none"
        )
    return _plan(options, options.protocol)


def _plan(options: Options, path: Path) -> int:
    """Plan the captures of a protocol, write them as a stage table, print; exit 0."""
    bench_protocol = config.load(path, BenchProtocol)
    design = lenses.load(options.lens)
    table = ["file,depth_um,angle_deg,relative_exposure"]
    with options.claim(options.output) as draft:
        plan = protocol.plan_captures(
            design, bench_protocol, log_response_slopes(design)
        )
        frames = np.column_stack([plan.depth_um, plan.angle_deg, plan.exposure])
        table += [
            f"frame_{i:03d}.tif,{z:.6g},{angle:.6g},{time:.6g}"
            for i, (z, angle, time) in enumerate(frames)
        ]
        store.write_text(draft.path, "\n".join(table) + "\n")
    values = {
        "file": str(options.output),
        "frames": frames.tolist(),
        "sigma": dict(zip(plan.names, plan.sigma.tolist(), strict=True)),
        "unstated_sigma": dict(
            zip(plan.names, plan.unstated_sigma.tolist(), strict=True)
        ),
        "warnings": list(plan.warnings),
    }
    lines = [f"{options.output}: {len(frames)} frames, the most informative first"]
    lines += [
        f"  {z:10.5g} um  {angle:6.3g} deg  relative exposure {time:g}"
        for z, angle, time in frames
    ]
    lines.append("  half of a 95 % interval, with what nobody states; within the model")
    for name, sigma, unstated in zip(
        plan.names, plan.sigma, plan.unstated_sigma, strict=True
    ):
        total = REACH * np.hypot(sigma, unstated)
        lines.append(f"  {name:<24} +- {total:<8.2g} {REACH * sigma:.2g}")
    lines += [f"  note: {words}" for words in plan.warnings]
    options.console.result(values, "\n".join(lines))
    return 0


def _simulate(options: Options, path: Path) -> int:
    """Simulate the captures of a hidden lens, write the capture folder, print; exit 0."""
    target = options.output
    truth = config.load(path, HiddenLens)
    design = lenses.load(options.lens)
    names = [k.name for k in truth.parameter if k.value]
    with options.claim_folder(target) as draft, options.shared():
        simulated = bench.simulate_frames(
            design, truth, log_response_slopes(design, names=names)
        )
        write_captures(draft.path, simulated, truth, design)
    count, peak_e = len(simulated.frames), float(simulated.electrons.max())
    options.console.result(
        {"folder": str(target), "frames": count, "peak_e": peak_e},
        f"{target}: {count} frames, peak {peak_e:.0f} electrons",
    )
    return 0


def write_captures(
    folder: Path, shots: SimulatedFrames, truth: HiddenLens, lens: Lens
) -> None:
    """Write frames and their description as :func:`characterize.load` reads them.

    Args:
        folder: an empty folder.
        shots: the frames.
        truth: what they were simulated of.
        lens: the design.
    """
    import tifffile

    depths, angles = truth.stated
    lines = ["file,depth_um,angle_deg"]
    for i, (frame, z, angle) in enumerate(
        zip(shots.frames, depths, angles, strict=True)
    ):
        name = f"frame_{i:03d}.tif"
        tifffile.imwrite(folder / name, frame, photometric="minisblack", metadata=None)
        lines.append(f"{name},{z:.10g},{np.degrees(angle[0]):.10g}")
    (folder / "stage.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    for name, stack in (("dark", shots.dark), ("flat", shots.flat)):
        tifffile.imwrite(
            folder / f"{name}.tif", stack, photometric="minisblack", metadata=None
        )
    description = {
        "pixel_um": truth.camera.pixel_um,
        "wavelength_um": lens.wavelength_um,
        "bits": truth.camera.bits,
    }
    description |= {
        "pixel_sigma_um": 0.0,
        **dict.fromkeys(_STATED, 0.0),
    }  # a bench knows what stands on it
    description |= {k.name: k.value for k in truth.parameter if k.name in _STATED}
    text = "".join(f"{name} = {value!r}\n" for name, value in description.items())
    (folder / "capture.toml").write_text(text, encoding="utf-8")
