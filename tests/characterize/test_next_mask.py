"""The next mask: closed forms where the process errs in one way, the layout's own
reading of the table, real gain.
"""

import numpy as np
import pytest

from characterize import next_mask
from characterize.model.parameters import parameter_vector, process_state_of
from codesign.optics import as_built_lens
from layout.process import process as processes
from metalens import lens
from metalens.core.errors import ConfigError
from metalens.fabrication import Bias, perturbed_transmission, proxy_sensitivity
from tests.codesign import made_lens as m

OLD = """
[bias]
table_nm = [[80, -6.0], [120, -3.5], [180, -1.0], [260, 0.5], [340, 1.0]]
"""


def _plan(old=None, **values):
    lens = m.small()
    none = next_mask.present_bias(None)
    return next_mask.propose_correction(
        lens,
        parameter_vector(values),
        response=proxy_sensitivity(lens),
        old=old or none,
    )


def test_a_constant_bias_becomes_a_constant_table():
    plan = _plan(bias_nm=6.0)
    assert np.allclose(plan.bias_nm, 6.0, atol=1e-9)
    assert np.allclose(plan.drawn_nm, plan.designed_um * 1e3 - 6.0, atol=1e-9)


def test_a_constant_bias_adds_to_the_present_table(tmp_path):
    (tmp_path / "process.toml").write_text(OLD)
    old = next_mask.present_bias(tmp_path / "process.toml")
    plan = _plan(old, bias_nm=2.0)
    assert np.allclose(plan.bias_nm, old.at(plan.drawn_nm) + 2.0, atol=1e-8)


def test_what_height_takes_from_the_phase_the_diameters_give_back():
    lens, x = m.small(), parameter_vector({"height_nm": -12.0})
    response = proxy_sensitivity(lens)
    plan = _plan(height_nm=-12.0)
    now = np.angle(
        perturbed_transmission(
            lens.proxy,
            response,
            plan.wanted_um,
            0.85,
            process_state_of(x).response_amounts(),
        )
    )
    meant = np.angle(
        perturbed_transmission(
            lens.proxy,
            response,
            plan.designed_um,
            0.85,
            process_state_of(parameter_vector()).response_amounts(),
        )
    )
    off = np.angle(np.exp(1j * (now - meant)))
    assert np.ptp(off) < 2e-3  # one piston for all; 4001 table nodes leave 1e-3
    assert np.abs(plan.wanted_um - plan.designed_um).max() > 5e-4


def test_the_layout_draws_what_the_table_means(tmp_path):
    plan = _plan(bias_nm=5.0, height_nm=-8.0)
    next_mask.write_correction(tmp_path, plan)
    made = processes.load_process(tmp_path / "bias.toml")
    assert np.allclose(
        made.bias.drawn_nm(plan.designed_um * 1e3), plan.drawn_nm, atol=2e-3
    )  # 3 decimals in the file
    (tmp_path / "other.toml").write_text('[bias]\ncsv = "bias.csv"\n')
    assert (
        processes.load_process(tmp_path / "other.toml").bias.table_nm
        == made.bias.table_nm
    )


@pytest.mark.parametrize("text", [OLD, "", "[bias]\ncsv = 'b.csv'\n"])
def test_the_present_bias_is_read_as_the_layout_reads_it(tmp_path, text):
    (tmp_path / "b.csv").write_text("# measured\ndrawn,bias\n90,-4\n200,1\n")
    (tmp_path / "p.toml").write_text(text)
    drawn = np.linspace(60, 400, 50)
    assert np.allclose(
        next_mask.present_bias(tmp_path / "p.toml").at(drawn),
        processes.load_process(tmp_path / "p.toml").bias.at(drawn),
    )


def test_no_process_file_and_nonsense_in_it_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.toml: no such file"):
        next_mask.present_bias(tmp_path / "absent.toml")
    (tmp_path / "p.toml").write_text("[bias]\ntable_nm = [[1, 2, 3]]\n")
    with pytest.raises(ConfigError, match=r"bias\.table_nm"):
        next_mask.present_bias(tmp_path / "p.toml")


def test_a_true_correction_gives_the_designed_lens_back():
    """With the fit equal to the truth, table and map leave aberrations and distance;
    the spacer leaves aberrations.
    """
    made = as_built_lens.MadeLens(m.small(), m.OPTICS)
    x = parameter_vector({k: v for k, v in m.TRUE.items() if k != "coma_x_rad"})
    plan = next_mask.propose_correction(
        m.small(), x, response=made.response, old=next_mask.present_bias(None)
    )
    steps = next_mask.predict_lenses(plan, m.small(), made.response, x, x)
    before, table, mapped, placed = steps
    goal = made.stack()

    def redrawn(lens):
        return as_built_lens.MadeLens(lens, m.OPTICS, response=made.response)

    first, last = (
        as_built_lens.psf_error(redrawn(p.lens).stack(p.parameters), goal)
        for p in (before, placed)
    )
    assert first > 0.05
    assert last < 0.01
    assert placed.strehl > 0.9995
    assert placed.strehl > before.strehl
    assert abs(mapped.light - 1) < 0.01
    assert table.strehl > before.strehl - 1e-3


def test_a_known_lens_has_a_next_mask_and_an_unknown_one_the_measurement_it_needs(
    tmp_path,
):
    """Bias of 6 nm known to 0.1 nm: its table takes 6 nm off; known to 9 nm: refused."""
    mask = next_mask.plan_next_mask(m.asbuilt(sigma=0.1), old=Bias())
    assert not mask.refused
    as_made, table, both = (step.strehl for step in mask.steps[:3])
    assert as_made < table < both <= 1
    assert f"{both:.3f}" in mask.summary
    next_mask.write_correction(tmp_path, mask.plan, prefix="as_")
    drawn = processes.load_process(tmp_path / "as_bias.toml").bias
    assert drawn.table_nm
    corrected = lens.load(tmp_path / "as_lens_corrected.h5").diameters.diameter_um
    designed = m.small().diameters.diameter_um
    rim = np.abs(corrected - designed)[60].max()
    assert rim == pytest.approx(4e-3 / 2 + 3e-3, abs=3e-3)  # gradient and bow at x = R
    open_ = next_mask.plan_next_mask(m.asbuilt(sigma=9.0), old=Bias())
    assert "leaves the bias table open" in open_.refused
    assert "bias_nm" in open_.summary
