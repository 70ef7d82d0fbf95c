"""The virtual bench on workers: the frames of this process, byte for byte, also where a
cluster loses a worker.
"""

import pytest

from characterize.bench import bench
from characterize.bench.bench import BenchCamera, HiddenLens
from characterize.model import KnownValue
from metalens.core import executor
from metalens.core.errors import ConfigError
from tests.characterize import bench_lens

TRUTH = HiddenLens(
    depths_um=bench_lens.DEPTHS[1:2],
    angles_deg=(0.0, 3.0),
    camera=BenchCamera(pixels=12),
    diameter_noise_nm=1.7,
    parameter=(
        KnownValue("bias_nm", 4.0, 0.0),
        KnownValue("bandwidth_nm", 1.0, 0.0),
        KnownValue("decentre_y_um", 1.3, 0.0),
    ),
)


@pytest.fixture(scope="module")
def here():
    return frames()


def frames():
    return bench.bench_irradiance(
        bench_lens.lens(), TRUTH, bench_lens.RESPONSE
    ).tobytes()


def test_frames_are_the_same_from_two_workers(here):
    with executor.run_on(processes=2):
        assert frames() == here


def test_pillars_of_another_colour_or_incidence_are_made_anew(monkeypatch):
    """What is kept for the last colour and incidence is told apart by both; the noise
    of a pillar is its own always.
    """
    asked = []

    def pillars(lens, response, x, *, noise_um, angle_rad):
        asked.append((x[bench.PLACE["wavelength_nm"]], angle_rad))
        return noise_um

    monkeypatch.setattr(bench.made, "as_built_transmission", pillars)
    hidden = bench._Made(bench_lens.lens(), TRUTH, bench_lens.RESPONSE)
    blue, red = TRUTH.vector(), TRUTH.vector()
    red[bench.PLACE["wavelength_nm"]] += 5.0
    made = [
        hidden.pillars(*one)
        for one in (
            (blue, 0.0),
            (blue.copy(), 0.0),
            (red, 0.0),
            (red, 0.1),
            (blue, 0.1),
        )
    ]
    assert asked == [(0.0, 0.0), (5.0, 0.0), (5.0, 0.1), (0.0, 0.1)]
    assert all((one == made[0]).all() for one in made)
    assert 0.9 * 1.7e-3 < made[0].std() < 1.1 * 1.7e-3


def test_fewer_than_one_worker_is_refused():
    with pytest.raises(ConfigError, match="0 workers"), executor.run_on(processes=0):
        pass
