"""One small good file of every kind that a command reads, and the reader that the
commands give it to.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from characterize.bench import Truth
from characterize.captures import capture as captures
from characterize.commands.fit import Metrology
from characterize.inference import asbuilt
from characterize.pupil import PupilSpec
from codesign.batches import pool
from codesign.budget import Entry, PlanConfig
from codesign.commands import budget as budgets
from codesign.commands.scene import Scene
from codesign.eye import dataset
from codesign.train import checkpoint
from codesign.train import run as runs
from codesign.train.inner import InnerConfig
from layout.commands import check as masks
from layout.dose import exposure
from layout.files import doses
from layout.process import Process, process
from layout.process.process import Exposure
from metalens import cli, design, lens, library, materials, psf
from metalens.cell.record import Cell, Index
from metalens.chain.stages import ChainFiles
from metalens.commands.design import Design
from metalens.commands.library import CellFile
from metalens.commands.psf import Settings
from metalens.design import phase_map
from metalens.ground import config, manifest, store
from metalens.lens.record import DiameterMap, Lens
from metalens.made import Sensitivity, bias
from metalens.pillars import Study
from metalens.pillars.proxy import Proxy
from metalens.pillars.record import PillarLibrary, Sweep

Reader = Callable[[Path], object]
CELL = Cell(pitch_um=0.30, pillar=Index(3.6))
FRAMES = (np.arange(2 * 12 * 14).reshape(2, 12, 14) * 37 % 1000).astype(np.uint16)
TEXTS: dict[str, tuple[str, str, Any]] = {
    "cell": (
        "cell.toml",
        "[cell]\npitch_um = 0.3\npillar = {n = 3.6}\n[sweep]\nwavelengths_um = [0.85]\n",
        CellFile,
    ),
    "design": (
        "design.toml",
        'profile = "cubic"\naperture_mm = 0.5\n[limits]\nmin_gap_nm = 70\n',
        Design,
    ),
    "psf_settings": (
        "psf.toml",
        "depths_mm = [16.0, 26.0, 0.5]\nangles_deg = [0.0, 10.0]\n",
        Settings,
    ),
    "process": (
        "process.toml",
        'name = "x"\n[rules]\ngrid_nm = 1\n[bias]\ntable_nm = [[80, -6.0]]\n',
        None,
    ),
    "truth": (
        "truth.toml",
        'depths_um = [18000.0]\n[[parameter]]\nname = "bias_nm"\nvalue = 3.0\n',
        Truth,
    ),
    "metrology": (
        "known.toml",
        '[[known]]\nname = "height_nm"\nvalue = -3.0\nsigma = 3.0\n',
        Metrology,
    ),
    "pupil_settings": (
        "pupil.toml",
        "numerical_aperture = 0.5\nwavelength_um = 0.6\npixel_um = 0.1\n",
        PupilSpec,
    ),
    "plan": (
        "plan.toml",
        "aperture_mm = 0.3\nstacks = 10\nframes = 100\nled_fwhm_nm = 30.0\n",
        PlanConfig,
    ),
    "chain": (
        "chain.toml",
        'cell = "c.toml"\ndesign = "d.toml"\nprocess = "p.toml"\n',
        ChainFiles,
    ),
    "scene": (
        "scene.toml",
        "frames = 2\npixels = 64\ngaze_deg = [18.0, 13.0]\n",
        Scene,
    ),
    "study": (
        "study.toml",
        "pitches_um = [0.3]\nheights_um = [0.7]\ntolerance = 1e-2\n",
        Study,
    ),
    "run": (
        "run.toml",
        'preset = "smoke"\n[inner]\nsteps = 3\n[run]\npitch_um = 18.0\n',
        None,
    ),
}
PAGE = """REFERENCES: "made up"
DATA:
  - type: tabulated nk
    data: |
        0.80 3.70 0.010
        0.85 3.60 0.005
        0.90 3.55 0.002
  - type: formula 1
    wavelength_range: 0.5 1.5
    coefficients: 0 0.6961663 0.0684043
"""
TABLE = "wavelength_um,n,k\n0.80,3.70,0.010\n0.85,3.60,0.005\n0.90,3.55,0.002\n"
STAGE = "file,page,depth_mm,angle_deg,exposure_s\nf.tif,0,18.0,0.0,0.01\nf.tif,1,22.5,1.5,0.01\n"
ABOUT = 'pixel_um = 3.0\nwavelength_um = 0.85\nbits = 10\ncamera = "x"\n'
DOSE = "radius_um,energy\n0.05,10.0\n0.1,4.0\n0.3,1.0\n1.0,0.3\n3.0,0.1\n10.0,0.01\n"
DOSES = "layer,datatype,relative_dose,dose_uC_cm2,step,name\n1,0,1.000000,100.000,pillars,x\n1,1,1.1,110.0,pillars,\n"
ZEMAX = "2 2 0.01 0.01 0 0 0\n0.1 0 0 0\n0.2 0 0 0\n0.3 0 0 0\n0.4 0 0 0 0\n"


def _shown(verb: str) -> Reader:
    """A command that only reads, as the command line calls it; what it prints is thrown
    away.
    """

    def read(path: Path) -> object:
        with (
            open(os.devnull, "w", errors="backslashreplace") as nowhere,
            contextlib.redirect_stdout(nowhere),
        ):
            module = __import__(cli.VERBS[verb][0], fromlist=["run"])
            return module.run(module.Options(path))

    return read


def _settings(path: Path) -> object:
    name = path.parent.name
    if name == "run":
        return runs.load(path)
    return (
        process.load(path) if name == "process" else config.load(path, TEXTS[name][2])
    )


def _map(path: Path) -> object:
    return phase_map.read(design.PhaseMap(path, None if path.suffix == ".dat" else 0.4))


def _checkpoint(path: Path) -> object:
    return checkpoint.load(path, settings=InnerConfig(steps=7))


def _about_folder(path: Path) -> object:
    return captures.load(path.parent)


READERS: dict[str, tuple[str, Reader]] = {
    **{kind: (name, _settings) for kind, (name, _, _) in TEXTS.items()},
    "lens": ("f.h5", lens.load), "library": ("f.h5", library.load), "psf": ("f.h5", psf.load),
    "asbuilt": ("f.h5", asbuilt.load), "budget": ("f.h5", budgets.load), "shard": ("f.h5", dataset.read_shard),
    "pool": ("f.h5", pool.load), "info": ("f.h5", _shown("info")), "capture_h5": ("f.h5", captures.load),
    "mat73": ("f.mat", _map), "mat5": ("f.mat", _map), "npy": ("f.npy", _map), "text_map": ("f.csv", _map),
    "zemax": ("f.dat", _map), "png": ("f.png", captures.load), "tiff": ("f.tif", captures.load),
    "tiff_deflated": ("f.tif", captures.load), "stage": ("stage.csv", _about_folder),
    "about": ("capture.toml", _about_folder), "gdsii": ("f.gds", masks.read), "oasis": ("f.oas", masks.read),
    "oasis_plain": ("f.oas", masks.read), "material_csv": ("m.csv", materials.read_csv),
    "material_page": ("m.yml", lambda path: materials.material(str(path))), "bias": ("b.csv", bias.read_csv),
    "exposure": ("d.csv", lambda path: exposure.point_exposure(Exposure(csv=path))), "doses": ("d.csv", doses.read),
    "checkpoint": ("c.safetensors", _checkpoint), "network": ("c.safetensors", _shown("info")),
    "manifest": ("manifest.json", lambda path: manifest.check(path.parent)),
}  # fmt: skip


def write(folder: Path) -> None:
    """One good file a kind, each in a folder of its own name."""
    for kind, (name, _) in READERS.items():
        (folder / kind).mkdir(parents=True, exist_ok=True)
        path = folder / kind / name
        if kind in TEXTS:
            path.write_text(TEXTS[kind][1])
        elif kind in _PLAIN:
            path.write_text(_PLAIN[kind])
    for make in (_artefacts, _frames, _maps, _masks, _states):
        make(folder)


_PLAIN = {
    "stage": STAGE,
    "about": ABOUT,
    "material_csv": TABLE,
    "material_page": PAGE,
    "exposure": DOSE,
    "doses": DOSES,
    "zemax": ZEMAX,
    "text_map": "0.1,0.2\n0.3,0.4\n",
    "bias": "drawn_nm,bias_nm\n80,-6\n120,1\n",
}


def _lens() -> Lens:
    proxy = Proxy(
        np.array([[8.0, 3.5]]), np.array([[0.9]]), (0.08, 0.21), (0.85, 0.85), 0.0, 0.0
    )
    diameters = np.linspace(0.08, 0.21, 36, dtype=np.float32).reshape(6, 6)
    return Lens(DiameterMap(diameters, 0.3), CELL, proxy, 0.85, 2000.0, 20_000.0, "map")


def _library() -> PillarLibrary:
    d = np.linspace(0.08, 0.21, 20)
    t = (0.9 * np.exp(55j * d))[None, None, None]
    parts = (
        np.zeros(1),
        np.array([0.85]),
        d,
        t,
        t,
        np.full(t.shape, 1e-4),
        np.ones(t.shape),
        np.zeros((0, 5)),
    )
    return PillarLibrary(CELL, Sweep(), ("x",), *parts, "modal", 20, _lens().proxy)


def _psf() -> psf.PsfStack:
    axis = (np.array([2e4]), np.zeros((1, 2)), np.array([0.85]), np.ones(1))
    light = np.random.default_rng(3).random((1, 1, 96, 96))
    return psf.PsfStack(
        light, np.ones((1, 1)), *axis, 0.75, np.zeros((1, 2)), 2000.0, 1e-4, 1e-5, "x"
    )


def asbuilt_of(design: Lens, response: Sensitivity) -> asbuilt.AsBuilt:
    """What a fit might have found of a lens, written down by hand."""
    one, frames = np.ones(2), np.ones((2, 4, 4))
    return asbuilt.AsBuilt(
        design=design, response=response, names=("bias_nm", "height_nm"), value=one,
        covariance=np.eye(2), information=np.eye(2), held={"index": 0.0}, depth_um=one, angle_rad=np.zeros((2, 2)),
        pixel_um=3.0, measured=frames, predicted=frames, nominal=frames, residual_sigma=frames, chi2_per_dof=1.0,
        converged=True, reason="made up",
    )  # fmt: skip


def _artefacts(folder: Path) -> None:
    lens.save(folder / "lens" / "f.h5", _lens())
    library.save(folder / "library" / "f.h5", _library())
    psf.save(folder / "psf" / "f.h5", _psf())
    psf.save(folder / "info" / "f.h5", _psf())
    asbuilt.save(
        folder / "asbuilt" / "f.h5",
        asbuilt_of(_lens(), Sensitivity(np.zeros((3, 6)), 0.15)),
    )
    budgets.save(
        folder / "budget" / "f.h5",
        [Entry("grid", 0.1, 0.2, 1e-4, "rounded")],
        store.Provenance(),
    )
    light = np.zeros((1, 2, 4, 4), np.uint8)
    about = {
        "radiance": light,
        "coverage": light[:, 0],
        "depth_um": light.astype(np.uint16),
        "pupil": light[:, 0],
    }
    store.save(
        folder / "shard" / "f.h5", "scene", about | {"labels/slip_um": np.zeros((1, 3))}
    )
    frames = {
        "light": light[0],
        "depth_um": light[0].astype(np.uint16),
        "mask": light[0],
    }
    places = {
        "place_um": np.ones((2, 3)),
        "seen_um": np.ones((2, 3)),
        "here_um": np.ones(3),
        "depths_um": np.ones(2),
    }
    pose = {
        "axis": np.ones((2, 3), np.float32),
        "points": np.zeros((2, 10, 2), np.float32),
    }
    store.save(folder / "pool" / "f.h5", "pool", frames | places | pose)


def _frames(folder: Path) -> None:
    import cv2
    import tifffile

    for kind, how in (
        ("tiff", {}),
        ("tiff_deflated", {"compression": "zlib", "predictor": True}),
    ):
        tifffile.imwrite(
            folder / kind / "f.tif", FRAMES, photometric="minisblack", **how
        )
    for kind in ("stage", "about"):
        tifffile.imwrite(folder / kind / "f.tif", FRAMES)
    (folder / "stage" / "capture.toml").write_text(ABOUT)
    (folder / "about" / "stage.csv").write_text(STAGE)
    cv2.imwrite(str(folder / "png" / "f.png"), FRAMES[0])
    with h5py.File(
        folder / "capture_h5" / "f.h5", "w", libver=("v110", "v110")
    ) as file:
        file.create_dataset(
            "frames", data=FRAMES, chunks=(1, 6, 7), compression="gzip", fletcher32=True
        )


def _maps(folder: Path) -> None:
    from scipy.io import savemat

    phase = np.array([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    np.save(folder / "npy" / "f.npy", phase)
    savemat(folder / "mat5" / "f.mat", {"p": phase, "words": "x"}, do_compression=True)
    with h5py.File(folder / "mat73" / "f.mat", "w", userblock_size=512) as file:
        file["p"] = phase


def _masks(folder: Path) -> None:
    import layout

    plan = layout.plan(_lens(), Process())
    layout.write_gdsii(plan, folder / "gdsii" / "f.gds")
    layout.write_oasis(plan, folder / "oasis" / "f.oas")
    layout.write_oasis(
        plan, folder / "oasis_plain" / "f.oas", form="reader", circles=True
    )


def _states(folder: Path) -> None:
    import torch

    for kind in ("checkpoint", "network"):
        state = {"net": {"w": torch.ones(3, 2)}, "counters": [1, 0, 0], "note": "x"}
        checkpoint.save(
            folder / kind / "c.safetensors", state, settings=InnerConfig(steps=7)
        )
    (folder / "manifest" / "a.txt").write_text("held")
    manifest.write(folder / "manifest", "design d.toml")
