"""One small lens without symmetry, from the cell to the lens as built, by the commands
that a user types; tests share its files through the session fixtures of conftest.py.
"""

import sys
from pathlib import Path

import numpy as np

from metalens.core import store
from tests.command_line import run

PITCH_UM, HEIGHT_UM, WAVELENGTH_UM, SITES = 0.30, 0.7, 0.85, 80
GLASS_N, GLASS_UM, AIR_UM = 1.52, 30.0, 60.0  # between pillars and sensor
SUBSTRATE_N, SUBSTRATE_UM = 1.45, 150.0  # between source and pillars
SOURCE_UM = 700.0
BIAS_TABLE_NM = ((80, -6.0), (120, -3.5), (180, -1.0), (260, 0.5))
BEAM = {"alpha_um": 0.012, "beta_um": 9.0, "eta": 0.6}
PIXEL_UM, PIXELS, GAIN_E, READ_E, OFFSET = 0.9, 21, 1.3, 2.4, 71
DEPTHS_UM = (450.0, 560.0, 700.0, 950.0, 1500.0)
PEAK_E = 7000.0
HIDDEN = {"bias_nm": -3.0, "distance_um": 1.5, "coma_x_rad": 0.12, "crosstalk_px": 0.02}
# All that the fit is not to look for; stage_zero_um, centre, gain and background stay.
STATED = ("bias_x_nm", "bias_y_nm", "bias_r_nm", "height_nm", "wavelength_nm",
          "stage_scale", "astigmatism_rad", "oblique_astigmatism_rad", "coma_y_rad",
          "trefoil_x_rad", "trefoil_y_rad", "spherical_rad", "background_x_e",
          "background_y_e")  # fmt: skip

SETTINGS = {
    "cell.toml": f"""
        [cell]
        pitch_um = {PITCH_UM}
        height_um = {HEIGHT_UM}
        pillar = {{ n = 3.6 }}
        substrate = {{ n = {SUBSTRATE_N} }}
        [sweep]
        wavelengths_um = [{WAVELENGTH_UM}]
    """,
    "design.toml": f"""
        profile = "map"
        aperture_mm = {SITES * PITCH_UM * 1e-3:.6g}
        wavelength_nm = {WAVELENGTH_UM * 1e3}
        sensor_distance_mm = {(GLASS_UM + AIR_UM) * 1e-3}
        source_distance_mm = {SOURCE_UM * 1e-3}
        library = "library.h5"
        [map]
        file = "phase.npy"
        pitch_um = {PITCH_UM}
        add_focus = true
        [[layers.front]]
        material = {{ n = {SUBSTRATE_N} }}
        thickness_um = {SUBSTRATE_UM}
        [[layers.behind]]
        material = {{ n = {GLASS_N} }}
        thickness_um = {GLASS_UM}
    """,
    "psf.toml": """
        depths_mm = [0.45, 0.7, 0.25]
        angles_deg = [0.0, 7.0]
        window_um = 14.0
        samples = 40
        tolerance = 1e-4
    """,
    "process.toml": f"""
        [rules]
        minimum_feature_nm = 80
        minimum_gap_nm = 70
        diameter_step_nm = 2
        vertices = 24
        [bias]
        table_nm = {[list(row) for row in BIAS_TABLE_NM]}
        [etch]
        corner_radius_nm = 0
        [exposure]
        base_uC_cm2 = 300
        alpha_um = {BEAM["alpha_um"]}
        beta_um = {BEAM["beta_um"]}
        eta = {BEAM["eta"]}
        tolerance = 0.01
        [die]
        margin_um = 330
        mark_um = 40
        label = "R4"
    """,
    "truth.toml": f"""
        depths_um = {list(DEPTHS_UM)}
        peak_e = {PEAK_E}
        seed = 3
        [camera]
        pixel_um = {PIXEL_UM}
        pixels = {PIXELS}
        bits = 14
        gain_e = {GAIN_E}
        read_noise_e = {READ_E}
        offset = {OFFSET}
    """
    + "".join(
        f'\n[[parameter]]\nname = "{name}"\nvalue = {value}\n'
        for name, value in HIDDEN.items()
    ),
    "metrology.toml": "".join(
        f'[[known]]\nname = "{name}"\nvalue = {value}\nsigma = 0.0\n'
        for name, value in {name: 0.0 for name in STATED}.items()
    )
    + '[[known]]\nname = "crosstalk_px"\nvalue = 0.02\nsigma = 0.0\n',
    "run.toml": """
        preset = "smoke"
        test_batches = 1
        validation_batches = 1
        scenes = { pixels = 32, margin = 4, pool = 4 }
        inner = { steps = 3, batch = 2 }
        search = { population = 2, tournament = 1, rounds = 2 }
        run = { pitch_um = 12.0, budgets_mmacs = [4.0] }
        [optics]
        image = "uniform"
        aperture_mm = 0.06
        sensor_distance_mm = 0.5
        sample_um = 12.0
        polynomials = 0
        depth_count = 3
        window_samples = 9
        [space]
        widths = [0.25]
        expansions = [3]
        kernels = [3]
        resolution = [0.5, 0.5]
    """,
}
SETTINGS["chain.toml"] = """
    cell = "cell.toml"
    design = "design.toml"
    process = "process.toml"
    psf = "psf.toml"
    run = "run.toml"
    bench_truth = "truth.toml"
    bench_metrology = "metrology.toml"
    budget = false
"""
STAGES = {  # the file or folder that a command leaves, and its words
    "library.h5": ("library", "cell.toml"),
    "lens.h5": ("design", "design.toml"),
    "psf.h5": ("psf", "lens.h5", "--config", "psf.toml"),
    "mask": ("layout", "lens.h5", "--process", "process.toml", "--oasis", "--gds"),
    "captures": ("capture", "lens.h5", "--truth", "truth.toml"),
    "asbuilt.h5": (
        "fit", "captures", "--design", "lens.h5", "--metrology", "metrology.toml",
    ),
    "run": ("codesign", "run.toml"),
}  # fmt: skip


def map_rad():
    """(y, x) phase added to the focus: coma along y, a saddle and a tilt."""
    u = (np.arange(SITES) - (SITES - 1) / 2) * PITCH_UM / 12.0
    x, y = np.meshgrid(u, u)
    return 1.5 * (3 * (x**2 + y**2) - 2) * y + 0.9 * x * y + 1.1 * x + 0.4 * y


def write_settings(folder: Path) -> None:
    """The settings files of all stages."""
    for name, text in SETTINGS.items():
        lines = [line.strip() for line in text.splitlines()]
        (folder / name).write_text("\n".join(lines) + "\n", encoding="utf-8")
    np.save(folder / "phase.npy", map_rad())


class Chain:
    """The chain in a folder: ``chain["psf.h5"]`` is its path, made when first asked for,
    by whichever process of the run asks first.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        folder.mkdir(exist_ok=True)
        with store.hold_lock(self.folder, wait=True):
            if not (folder / "phase.npy").exists():
                write_settings(folder)

    def __getitem__(self, target: str) -> Path:
        for needed in STAGES[target]:
            if needed in STAGES and needed != target:
                _ = self[needed]
        if target == "lens.h5":
            _ = self["library.h5"]
        with store.hold_lock(self.folder, wait=True):
            if not (self.folder / target).exists():  # results appear whole
                done = run(*STAGES[target], "-o", target, "--quiet", cwd=self.folder)
                if done.returncode:
                    raise RuntimeError(f"{target}: {done.stderr or done.stdout}")
        return self.folder / target


if __name__ == "__main__":  # the settings, for ``metalens demo --config``
    target = Path(sys.argv[1])
    target.mkdir(parents=True)
    write_settings(target)
