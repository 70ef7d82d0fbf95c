"""Phase maps of other programs: every format gives the same phase, the right way up, or
a refusal that says why.
"""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.io import savemat

from metalens.core.errors import ConfigError, LensError
from metalens.design import phase_map
from metalens.design.profiles import PhaseMap

STEP = 2.0
X = (np.arange(24) - 11.5) * STEP
Y = (np.arange(20) - 9.5) * STEP
# no symmetry: a turned or mirrored axis shows
PHASE = 0.02 * X + 0.05 * Y[:, None] + 0.001 * X * Y[:, None]


def zemax_text(phase, *, step_mm=STEP * 1e-3, unit=0, dec=(0.0, 0.0), nodata=()):
    """What OpticStudio reads: the point of least x and largest (upward) y first; our
    row 0 is the top.
    """
    lines = [
        f"{phase.shape[1]} {phase.shape[0]} {step_mm:.17g} {step_mm:.17g} {unit} {dec[0]:.17g} {dec[1]:.17g}"
    ]
    for i, value in enumerate(phase.ravel()):
        lines.append(f"{value:.17g} 0 0 0 {int(i in nodata)}")
    return "\n".join(lines) + "\n"


def write(folder, kind):
    path = folder / f"map.{kind.split('-')[0]}"
    if kind == "npy":
        np.save(path, PHASE)
    elif kind == "csv":
        np.savetxt(path, PHASE, delimiter=",", fmt="%.17g")
    elif kind == "csv-semicolon":
        text = "\n".join(";".join(f"{v:.17g}" for v in row) for row in PHASE)
        # Excel starts with a byte-order mark
        path.write_text("\ufeff" + text, encoding="utf-8")
    elif kind in (
        "csv-decimal-comma",
        "txt-decimal-comma",
    ):  # of a spreadsheet in half of Europe
        mark = ";" if kind[0] == "c" else "\t"
        rows = (mark.join(f"{v:.17g}".replace(".", ",") for v in row) for row in PHASE)
        path.write_bytes(("\ufeff" + "\r\n".join(rows)).encode("utf-8"))
    elif kind == "txt":
        np.savetxt(path, PHASE, fmt="%.17g")
    elif kind in ("mat", "mat-packed"):
        about = {"phi": PHASE, "note": "text", "scale": 3.0}
        savemat(path, about, do_compression=kind == "mat-packed")
    elif kind == "mat-73":
        with h5py.File(path, "w") as file:
            file["phi"] = PHASE.T  # MATLAB keeps columns first
    else:
        path.write_text(zemax_text(PHASE))
    return path


@pytest.mark.parametrize(
    "kind",
    [
        "npy",
        "csv",
        "csv-semicolon",
        "csv-decimal-comma",
        "txt",
        "txt-decimal-comma",
        "mat",
        "mat-packed",
        "mat-73",
        "dat",
    ],
)
def test_every_format_gives_the_same_samples(tmp_path, kind):
    path = write(tmp_path, kind)
    samples = phase_map.read_phase_map(PhaseMap(path, None if kind == "dat" else STEP))
    assert samples.phase_rad == pytest.approx(PHASE, abs=1e-15)
    assert samples.step_um == pytest.approx((STEP, STEP))
    x, y = np.array([-7.3, 0.0, 12.1]), np.array([-15.2, 3.3])
    got = phase_map.interpolate_phase(samples, x, y)
    want = 0.02 * x + 0.05 * y[:, None] + 0.001 * x * y[:, None]
    # phasors turn by 0.15 rad a step: error of the chord 0.15³/60
    assert got == pytest.approx(want, abs=2e-4)


def test_zemax_units_and_decentre(tmp_path):
    for unit, um in enumerate((1e3, 1e4, 25.4e3, 1e6)):
        (tmp_path / "g.dat").write_text(
            zemax_text(PHASE, step_mm=STEP / um, unit=unit, dec=(4 / um, 6 / um))
        )
        samples = phase_map.read_phase_map(PhaseMap(tmp_path / "g.dat"))
        assert samples.step_um == pytest.approx((STEP, STEP), rel=1e-12)
        # up in the file is -y here
        assert samples.centre_um == pytest.approx((4.0, -6.0), rel=1e-9)
        shifted = phase_map.interpolate_phase(
            samples, np.array([4 + X[5]]), np.array([Y[3] - 6])
        )
        assert shifted[0, 0] == pytest.approx(PHASE[3, 5], abs=1e-9)


def test_points_without_data_matter_inside_the_aperture_alone(tmp_path):
    # the upper left corner
    (tmp_path / "g.dat").write_text(zemax_text(PHASE, nodata={0, 1, 24}))
    samples = phase_map.read_phase_map(PhaseMap(tmp_path / "g.dat"))
    assert np.isnan(samples.phase_rad).sum() == 3
    x = np.linspace(-17, 17, 30)
    assert np.isfinite(
        phase_map.interpolate_phase(samples, x, x, radius_um=10.0)[10:20, 10:20]
    ).all()
    with pytest.raises(LensError, match="no data near row 0"):
        phase_map.interpolate_phase(samples, x - 5, x - 2, radius_um=60.0)


@pytest.mark.parametrize("kind", ["rad", "complex"])
def test_arrays_in_memory_have_a_step_for_each_axis(kind):
    values = PHASE if kind == "rad" else 0.7 * np.exp(1j * PHASE)
    samples = phase_map.read_phase_map(PhaseMap(values, (STEP, 3 * STEP)))
    assert samples.step_um == (STEP, 3 * STEP)
    turn = np.exp(1j * (samples.phase_rad - PHASE))
    assert turn == pytest.approx(np.ones(PHASE.shape))
    x, y = X[4:6], 3 * Y[9:11]
    phase = phase_map.interpolate_phase(samples, x, y)
    assert np.exp(1j * phase) == pytest.approx(np.exp(1j * PHASE[9:11, 4:6]))


def test_magnitudes_that_pillars_do_not_make_are_refused():
    with pytest.raises(LensError, match="phase alone"):
        phase_map.read_phase_map(PhaseMap(np.exp(1j * PHASE) * (2 + X / 50), STEP))
    hole = np.exp(1j * PHASE)
    hole[3, 5] = 0
    samples = phase_map.read_phase_map(PhaseMap(hole, STEP))
    assert np.argwhere(np.isnan(samples.phase_rad)).tolist() == [[3, 5]]


def test_rows_of_x_y_phase_may_fill_a_round_aperture_alone(tmp_path):
    inside = np.hypot(X / X[-1], Y[:, None] / Y[-1]) <= 1.01
    y, x = np.broadcast_arrays(Y[:, None], X)
    np.savetxt(tmp_path / "m.txt", np.stack([x, y, PHASE], 2)[inside])
    samples = phase_map.read_phase_map(PhaseMap(tmp_path / "m.txt"))
    assert np.array_equal(np.isfinite(samples.phase_rad), inside)
    assert samples.phase_rad[inside] == pytest.approx(PHASE[inside])
    assert samples.step_um == pytest.approx((STEP, STEP))


def test_conjugate_turns_the_sign(tmp_path):
    path = write(tmp_path, "npy")
    assert phase_map.read_phase_map(
        PhaseMap(path, STEP, conjugate=True)
    ).phase_rad == pytest.approx(-PHASE)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.dat", b"", "empty"),
        ("a.dat", b"3 3 0.1 0.1\n", "need nx ny delx"),
        ("a.dat", b"3 3 0.1 0.1 7 0 0\n", "unitflag 0 to 3"),
        ("a.dat", b"2 2 0.1 0.1 0 0 0\n0 0 0 0\n", "1 points for a grid of 2 x 2"),
        ("a.dat", b"2 2 0.1 0.1 0 0 0\n0\n0\ninf\n0\n", "column 0 is inf"),
        ("a.dat", b"2 2 0.1 0.1 0 0 0\n0\n0\nabc\n0\n", "string to float: 'abc'"),
        ("a.dat", b"\xff\xfe\x00\x01", "binary"),
        ("a.csv", b"1,2\n3,x\n", "not a phase map"),
        ("a.csv", b"1,2\n3\n", "not a phase map"),
        ("a.npy", b"\x93NUMPY", "not a phase map"),
        ("a.mat", b"MATLAB 5.0 MAT-file", "not a MATLAB file"),
        ("a.npz", b"PK\x03\x04", "not an NPZ file"),
    ],
)
def test_broken_files_are_refused_by_name(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    pitch = None if name.endswith("dat") else 1.0
    with pytest.raises(LensError, match=message) as refusal:
        phase_map.read_phase_map(PhaseMap(tmp_path / name, pitch))
    assert name in str(refusal.value)


def test_settings_that_do_not_fit_the_file_are_refused(tmp_path):
    path = write(tmp_path, "npy")
    with pytest.raises(LensError, match="give pitch_um"):
        phase_map.read_phase_map(PhaseMap(path))
    with pytest.raises(LensError, match=r"is for \.mat and \.npz files"):
        phase_map.read_phase_map(PhaseMap(path, 1.0, variable="phi"))
    with pytest.raises(LensError, match="leave pitch_um out"):
        phase_map.read_phase_map(PhaseMap(write(tmp_path, "dat"), 3.0))
    with pytest.raises(ConfigError, match="pitch_um"):
        PhaseMap(path, -1.0)


def test_a_matrix_is_chosen_by_name_where_there_are_several(tmp_path):
    savemat(tmp_path / "m.mat", {"phi": PHASE, "other": PHASE + 1})
    with pytest.raises(LensError, match=r"2 matrices \(other, phi\)"):
        phase_map.read_phase_map(PhaseMap(tmp_path / "m.mat", STEP))
    with pytest.raises(LensError, match="did you mean 'phi'"):
        phase_map.read_phase_map(PhaseMap(tmp_path / "m.mat", STEP, variable="ph"))
    assert phase_map.read_phase_map(
        PhaseMap(tmp_path / "m.mat", STEP, variable="phi")
    ).phase_rad == pytest.approx(PHASE)


def test_an_archive_of_numpy_gives_its_only_matrix_or_the_named_one(tmp_path):
    np.savez(tmp_path / "one.npz", phase=PHASE, pitch_um=STEP, x_um=np.arange(9))
    assert phase_map.read_phase_map(
        PhaseMap(tmp_path / "one.npz", STEP)
    ).phase_rad == pytest.approx(PHASE)
    np.savez_compressed(tmp_path / "two.npz", phase=PHASE, amplitude=PHASE + 1)
    with pytest.raises(LensError, match=r"2 matrices \(amplitude, phase\); name one"):
        phase_map.read_phase_map(PhaseMap(tmp_path / "two.npz", STEP))
    assert phase_map.read_phase_map(
        PhaseMap(tmp_path / "two.npz", STEP, variable="phase")
    ).phase_rad == pytest.approx(PHASE)
    np.savez(tmp_path / "objects.npz", phase=np.array([{}], dtype=object))
    with pytest.raises(LensError, match=r"objects\.npz: not an NPZ file"):
        phase_map.read_phase_map(PhaseMap(tmp_path / "objects.npz", STEP))


@settings(max_examples=160)
@given(
    kind=st.sampled_from(["npy", "csv", "txt", "mat", "mat-packed", "mat-73", "dat"]),
    data=st.data(),
)
def test_damaged_files_are_refused_or_read(tmp_path_factory, kind, data):
    """Truncated or with a flipped bit: a typed refusal or a map, never another
    exception.
    """
    path = write(tmp_path_factory.mktemp("fuzz"), kind)
    whole = bytearray(path.read_bytes())
    if data.draw(st.booleans(), label="truncate"):
        whole = whole[: data.draw(st.integers(0, len(whole) - 1), label="length")]
    else:
        whole[data.draw(st.integers(0, len(whole) - 1), label="byte")] ^= (
            1 << data.draw(st.integers(0, 7), label="bit")
        )
    path.write_bytes(bytes(whole))
    try:
        samples = phase_map.read_phase_map(
            PhaseMap(path, None if kind == "dat" else STEP)
        )
    except LensError:
        return
    assert samples.phase_rad.ndim == 2


@pytest.mark.parametrize("charge", [1, -2, 5])
@pytest.mark.parametrize("count", [81, 84])
def test_a_vortex_is_read_however_fine_its_map_is(charge, count):
    """exp(i m phi) beside a saddle, on pillars that stand on its axis or beside it:
    within half of the turn from a
    sample to the next beyond four samples, the phase of a sample nearby within."""
    x = (np.arange(count) - (count - 1) / 2) * 0.25
    x0, y0 = 0.31, -0.82
    phase = charge * np.arctan2(x[:, None] - y0, x - x0) + 0.03 * x * x[:, None]
    samples = phase_map.PhaseSamples(phase, (0.25, 0.25))
    for at in (np.arange(-25, 26) * 0.3, np.arange(-25, 25) * 0.3 + 0.15):
        found = phase_map.interpolate_phase(samples, at + x0, at + y0, radius_um=8.0)
        want = charge * np.arctan2(at[:, None], at) + 0.03 * (at + x0) * (
            at[:, None] + y0
        )
        off = np.abs(np.angle(np.exp(1j * (found - want))))
        radius = np.hypot(at, at[:, None])
        far = (radius > 1.0) & (radius < 7.0)
        assert (off[far] < abs(charge) * 0.25**2 / radius[far] ** 2 + 5e-3).all()
        samples_near = phase[np.hypot(x - x0, x[:, None] - y0) < 1.0]
        turns = (found[radius < 0.4, None] - samples_near) / (2 * np.pi)
        assert (abs(turns - np.rint(turns)).min(1) < 0.1).all()


def test_maps_that_are_too_coarse_are_refused_beside_a_vortex_too():
    """Steps of 0.8 half-turns along x; a step of a half-turn along a line; both with a
    vortex of charge 2 in them.
    """
    x = np.arange(-20, 21) * 0.5
    vortex = 2 * np.arctan2(x[:, None] + 0.1, x - 0.1)
    for more in (0.8 * np.pi / 0.5 * x, np.where(x > 0.2, np.pi, 0.0)):
        samples = phase_map.PhaseSamples(vortex + more, (0.5, 0.5))
        with pytest.raises(LensError, match="finer pitch"):
            phase_map.interpolate_phase(
                samples, np.arange(-20, 20) * 0.3 + 0.25, np.arange(-20, 20) * 0.3
            )
