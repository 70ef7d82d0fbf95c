"""Phase maps as other programs save them: units, tables with headers, missing data."""

import numpy as np
import pytest
from scipy.io import savemat

from metalens.core.errors import ConfigError, LensError
from metalens.design import phase_map
from metalens.design.profiles import PhaseMap

STEP = 0.3
X = (np.arange(41) - 20) * STEP
Y = (np.arange(37) - 18) * STEP
PHASE = -0.11 * (X**2 + (Y[:, None] - 0.4) ** 2) + 0.07 * X  # no symmetry, unwrapped
WRAPPED = PHASE % (2 * np.pi)


def read(path, pitch=STEP, **settings):
    return phase_map.read_phase_map(PhaseMap(path, pitch, **settings))


def phasor_error(samples, phase):
    return abs(np.exp(1j * samples.phase_rad) - np.exp(1j * phase)).max()


def test_levels_of_8_bits_are_refused_as_radians_and_read_as_stated(tmp_path):
    levels = np.floor(WRAPPED / (2 * np.pi) * 256).astype(np.uint8)
    np.save(tmp_path / "a.npy", levels)
    np.savetxt(tmp_path / "a.csv", levels, fmt="%d", delimiter=",")
    savemat(tmp_path / "a.mat", {"phi": levels.astype(float)})
    for name in ("a.npy", "a.csv", "a.mat"):
        with pytest.raises(LensError, match="levels = 256"):
            read(tmp_path / name)
        # a level is 2 pi / 256 wide, by definition
        found = read(tmp_path / name, levels=256).phase_rad
        assert found == pytest.approx(2 * np.pi / 256 * levels)
    assert read(tmp_path / "a.npy", unit="rad").phase_rad.max() == levels.max()
    with pytest.raises(LensError, match="levels = 16"):
        read(tmp_path / "a.npy", levels=16)
    with pytest.raises(ConfigError, match="levels"):
        PhaseMap(tmp_path / "a.npy", STEP, levels=256, unit="rad")


@pytest.mark.parametrize(
    ("unit", "full", "low"), [("deg", 360.0, -180.0), ("waves", 1.0, 0.0)]
)
def test_other_units_are_refused_as_radians_and_read_as_stated(
    tmp_path, unit, full, low
):
    np.save(tmp_path / "a.npy", (PHASE * full / (2 * np.pi) - low) % full + low)
    with pytest.raises(LensError, match=f"unit = '{unit}'"):
        read(tmp_path / "a.npy")
    assert phasor_error(read(tmp_path / "a.npy", unit=unit), PHASE) < 1e-12


def test_scaled_levels_are_not_taken_for_radians(tmp_path):
    np.save(tmp_path / "a.npy", WRAPPED / (2 * np.pi) * 255)
    with pytest.raises(LensError, match="levels = 256"):
        read(tmp_path / "a.npy")


def test_radians_wrapped_or_not_need_no_unit(tmp_path):
    for phase in (PHASE, WRAPPED, WRAPPED - np.pi, 40 * PHASE, np.zeros((5, 5))):
        np.save(tmp_path / "a.npy", phase)
        assert (read(tmp_path / "a.npy").phase_rad == phase).all()


@pytest.mark.parametrize("ending", ["npy", "csv", "mat"])
def test_nan_outside_the_aperture_is_no_data(tmp_path, ending):
    radius = 4.9
    phase = np.where(X**2 + Y[:, None] ** 2 <= radius**2, PHASE, np.nan)
    path = tmp_path / f"a.{ending}"
    if ending == "npy":
        np.save(path, phase)
    elif ending == "csv":
        np.savetxt(path, phase, delimiter=",")
    else:
        savemat(path, {"phi": phase})
    samples = read(path)
    at = np.linspace(-4.85, 4.85, 52)
    got = phase_map.interpolate_phase(samples, at, at, radius_um=radius)
    inside = at**2 + at[:, None] ** 2 <= radius**2
    want = -0.11 * (at**2 + (at[:, None] - 0.4) ** 2) + 0.07 * at
    off = np.abs(np.angle(np.exp(1j * (got - want))))
    # at the rim that of a sample within a step: 0.42 um of a slope of 1.2 rad/um
    assert off[inside].max() < 0.5
    assert off[at**2 + at[:, None] ** 2 < (radius - 0.45) ** 2].max() < 0.01
    phase[18, 22] = np.nan
    np.save(tmp_path / "hole.npy", phase)
    with pytest.raises(LensError, match=r"no data near row 17\.7, column 21"):
        phase_map.interpolate_phase(
            read(tmp_path / "hole.npy"), at, at, radius_um=radius
        )


def test_rows_and_columns_that_count_are_no_phase(tmp_path):
    """As tables are saved with and without their index."""
    heads = ",".join(str(i) for i in range(len(X)))
    rows = [",".join(f"{v:.17g}" for v in row) for row in PHASE]
    numbered = [f"{i},{row}" for i, row in enumerate(rows)]
    named = ",".join(f"c{i}" for i in range(len(X)))
    for lines in (
        [heads, *rows],
        ["," + heads, *numbered],
        [named, *rows],
        ["," + named, *numbered],
        ["% phase of a lens", "# rad", "// by hand", *rows],
        rows,
    ):
        (tmp_path / "a.csv").write_text("\n".join(lines))
        assert (read(tmp_path / "a.csv").phase_rad == PHASE).all()


@pytest.mark.parametrize(
    ("head", "scale"), [("x (um)", 1), ("x_nm", 1e3), ("x [mm]", 1e-3)]
)
def test_rows_of_x_y_and_phase_bring_their_grid(tmp_path, head, scale):
    x, y = np.meshgrid(X + 1.5, Y - 0.6)
    rows = np.column_stack([x.ravel() * scale, y.ravel() * scale, PHASE.ravel()])
    rows = np.random.default_rng(11).permutation(rows)
    names = f"{head},{head.replace('x', 'y')},phase (rad)\n"
    text = "\n".join(",".join(f"{v:.12g}" for v in row) for row in rows)
    (tmp_path / "a.csv").write_text(names + text)
    samples = read(tmp_path / "a.csv", None)
    assert samples.phase_rad == pytest.approx(PHASE, abs=1e-9)
    assert samples.step_um == pytest.approx((STEP, STEP), rel=1e-9)
    assert samples.centre_um == pytest.approx((1.5, -0.6), rel=1e-9)
    assert phase_map.interpolate_phase(samples, X[7:8] + 1.5, Y[30:31] - 0.6)[
        0, 0
    ] == pytest.approx(np.angle(np.exp(1j * PHASE[30, 7])), abs=1e-9)
    with pytest.raises(LensError, match="leave pitch_um out"):
        read(tmp_path / "a.csv", 0.5)


def test_triples_off_a_grid_and_words_are_refused_with_the_cure(tmp_path):
    (tmp_path / "a.csv").write_text("x,y,phase\n0,0,1.2\n1,0,0.3\n2.5,1,0.2\n0,1,0.7\n")
    with pytest.raises(LensError, match="even grid, or a matrix"):
        read(tmp_path / "a.csv", None)
    (tmp_path / "b.csv").write_text("1.5,2.5\n3.5,abc\n")
    with pytest.raises(LensError, match="rows of numbers, or columns x, y and phase"):
        read(tmp_path / "b.csv")


def test_text_of_utf_16_is_text(tmp_path):
    text = "\n".join("\t".join(f"{v:.17g}" for v in row) for row in PHASE)
    (tmp_path / "a.txt").write_text(text, encoding="utf-16")
    assert (read(tmp_path / "a.txt").phase_rad == PHASE).all()


def test_shared_cases(shared):
    """The header row is no phase; rows of x, y and phase are read as such."""
    samples = read(shared / "cases" / "pandas_noindex.csv")
    assert samples.phase_rad.shape == (121, 121)
    with pytest.raises(LensError, match="even grid"):
        read(shared / "cases" / "triples_head.csv", None)
