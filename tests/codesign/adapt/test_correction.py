"""The next mask: closed forms where the process errs in one way, the layout's own
reading of the table, real gain.
"""

import numpy as np
import pytest

from characterize.model.parameters import parameter_vector, process_state_of
from codesign.adapt import correction
from codesign.optics import built
from layout.process import process as processes
from metalens.core.errors import ConfigError
from metalens.fabrication import perturbed_transmission, proxy_sensitivity
from tests.codesign import made_lens as m

OLD = """
[bias]
table_nm = [[80, -6.0], [120, -3.5], [180, -1.0], [260, 0.5], [340, 1.0]]
"""


def _plan(old=None, **values):
    lens = m.small()
    none = correction.present_bias(None)
    return correction.propose_correction(
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
    old = correction.present_bias(tmp_path / "process.toml")
    plan = _plan(old, bias_nm=2.0)
    assert np.allclose(plan.bias_nm, old.at(plan.drawn_nm) + 2.0, atol=1e-8)


def test_what_height_takes_from_the_phase_the_diameters_give_back():
    lens, x = m.small(), parameter_vector({"height_nm": -12.0})
    response = proxy_sensitivity(lens)
    plan = _plan(height_nm=-12.0)
    now = np.angle(
        perturbed_transmission(
            lens.proxy, response, plan.wanted_um, 0.85, process_state_of(x).answers()
        )
    )
    meant = np.angle(
        perturbed_transmission(
            lens.proxy,
            response,
            plan.designed_um,
            0.85,
            process_state_of(parameter_vector()).answers(),
        )
    )
    off = np.angle(np.exp(1j * (now - meant)))
    assert np.ptp(off) < 2e-3  # one piston for all; 4001 table nodes leave 1e-3
    assert np.abs(plan.wanted_um - plan.designed_um).max() > 5e-4


def test_the_layout_draws_what_the_table_means(tmp_path):
    plan = _plan(bias_nm=5.0, height_nm=-8.0)
    correction.write_correction(tmp_path, plan)
    made = processes.load_process(tmp_path / "bias.toml")
    assert np.allclose(
        made.bias.drawn_nm(plan.designed_um * 1e3), plan.drawn_nm, atol=2e-3
    )  # 3 decimals in the file
    (tmp_path / "other.toml").write_text('[bias]\ncsv = "bias.csv"\n')
    assert (
        processes.load_process(tmp_path / "other.toml").bias.table_nm
        == made.bias.table_nm
    )


@pytest.mark.parametrize(
    "text", [OLD, "[bias]\ncurve_nm = [-3.0, 1.5]\n", "", "[bias]\ncsv = 'b.csv'\n"]
)
def test_the_present_bias_is_read_as_the_layout_reads_it(tmp_path, text):
    (tmp_path / "b.csv").write_text("# measured\ndrawn,bias\n90,-4\n200,1\n")
    (tmp_path / "p.toml").write_text(text)
    drawn = np.linspace(60, 400, 50)
    assert np.allclose(
        correction.present_bias(tmp_path / "p.toml").at(drawn),
        processes.load_process(tmp_path / "p.toml").bias.at(drawn),
    )


def test_no_process_file_and_nonsense_in_it_are_refused(tmp_path):
    with pytest.raises(ConfigError, match=r"absent\.toml: no such file"):
        correction.present_bias(tmp_path / "absent.toml")
    (tmp_path / "p.toml").write_text("[bias]\ntable_nm = [[1, 2, 3]]\n")
    with pytest.raises(ConfigError, match=r"bias\.table_nm"):
        correction.present_bias(tmp_path / "p.toml")


def test_a_true_correction_gives_the_designed_lens_back():
    """With the fit equal to the truth, table and map leave aberrations and distance;
    the spacer leaves aberrations.
    """
    made = built.MadeLens(m.small(), m.OPTICS)
    x = parameter_vector({k: v for k, v in m.TRUE.items() if k != "coma_x_rad"})
    plan = correction.propose_correction(
        m.small(), x, response=made.response, old=correction.present_bias(None)
    )
    before, table, mapped, placed = correction.next_lenses(made, plan, x, x)
    goal = made.stack()
    errors = [built.psf_error(p.stack, goal) for p in (before, table, mapped, placed)]
    assert errors[0] > 0.05
    assert errors[3] < 0.01
    assert placed.strehl > 0.9995
    assert placed.strehl > before.strehl
    assert abs(mapped.light - 1) < 0.01
    assert table.strehl > before.strehl - 1e-3
