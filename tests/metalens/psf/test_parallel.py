"""Two processes give the same PSFs and gradients as one; really launched."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from metalens.ground.errors import PropagationError
from metalens.psf import parallel

SCRIPT = """
import sys
import numpy as np
import torch
from metalens.psf import parallel

torch.set_num_threads(1)
rank, size = parallel.join("gloo")
x = (torch.arange(48, dtype=torch.float64) - 23.5) * 0.4
r2 = x**2 + x[:, None] ** 2
base = -2 * torch.pi / 0.85 * r2 / 250
base = base + 0.3 * torch.randn(48, 48, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
level = (r2 < 81).double()
common = dict(pitch_um=0.4, sensor_distance_um=120.0, window_um=16.0, samples=12, tolerance=1e-6)
runs = {
    "depth": dict(wavelength_um=0.85, depths_um=[900.0, 1200.0, 2000.0]),
    "angle": dict(wavelength_um=0.85, depths_um=[900.0, 1200.0], angle_rad=[[0.0, 0.0], [0.1, 0.0], [0.0, 0.2]]),
    "wavelength": dict(wavelength_um=[0.83, 0.85, 0.87], weights=[1.0, 2.0, 1.0], depths_um=[900.0, 1200.0]),
}
out = {}
for axis, arguments in runs.items():
    phase = base.clone().requires_grad_()
    given = phase.expand(3, 48, 48) if axis == "wavelength" else phase
    stack = parallel.psf_stack_shared(given, level, axis=axis, **common, **arguments)
    loss = (stack.intensity**2).sum() * 100 + 1e-3 * stack.energy_um2.sum()
    loss.backward()
    parallel.share_gradients(phase)
    out |= {f"{axis}/psf": stack.numpy().intensity, f"{axis}/energy": stack.numpy().energy_um2}
    out[f"{axis}/grad"] = phase.grad.numpy()
    out[f"{axis}/depths"], out[f"{axis}/angles"] = stack.depths_um, stack.angles_rad
    out[f"{axis}/error"] = stack.error
np.savez(f"{sys.argv[1]}_{size}_{rank}.npz", **out)
parallel.leave()
"""


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder = tmp_path_factory.mktemp("parallel")
    script = folder / "shared.py"
    script.write_text(SCRIPT)
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[3])}
    plain = [sys.executable, str(script), str(folder / "out")]
    launch = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    for command in (plain, [*launch, str(script), str(folder / "out")]):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr[-3000:]
    return [dict(np.load(folder / f"out_{size}_{rank}.npz")) for size, rank in ((1, 0), (2, 0), (2, 1))]


@pytest.mark.parametrize("axis", ["depth", "angle", "wavelength"])
def test_two_processes_give_the_psfs_and_gradients_of_one(results, axis):
    alone, *both = results
    for part in both:
        assert part[f"{axis}/psf"].shape == alone[f"{axis}/psf"].shape
        assert np.array_equal(part[f"{axis}/depths"], alone[f"{axis}/depths"])
        assert np.allclose(part[f"{axis}/angles"], alone[f"{axis}/angles"], atol=1e-15)
        for name in ("psf", "energy", "grad"):
            a, b = part[f"{axis}/{name}"], alone[f"{axis}/{name}"]
            # both within the tolerance of 1e-6, but with depth bases of their own
            assert np.linalg.norm(a - b) < 4e-6 * np.linalg.norm(b), name
    for name in ("psf", "grad"):
        assert np.array_equal(both[0][f"{axis}/{name}"], both[1][f"{axis}/{name}"])


def test_alone_everything_is_the_identity():
    part = torch.arange(6.0).view(3, 2)
    assert parallel.join() == (0, 1)
    assert parallel.share(7) == slice(0, 7)
    assert parallel.gather(part, 3) is part
    assert parallel.add(part) is part


def test_an_axis_with_nothing_to_split_is_refused():
    with pytest.raises(PropagationError, match="to split"):
        parallel.psf_stack_shared(
            torch.zeros(4, 4),
            torch.ones(4, 4),
            axis="angle",
            pitch_um=0.4,
            wavelength_um=0.85,
            sensor_distance_um=50.0,
            depths_um=[900.0],
            angle_rad=0.1,
            window_um=8.0,
            samples=4,
        )


@pytest.mark.parametrize("weights", [None, [1.0, 3.0, 2.0]])
def test_a_share_of_the_wavelengths_gives_its_share_of_the_light(monkeypatch, weights):
    """The parts of two processes, one after the other, add up to the light of one; equal weights by default."""
    monkeypatch.setattr(parallel, "add", lambda tensor: tensor)
    monkeypatch.setattr(parallel.dist, "all_reduce", lambda *words, **more: None)
    generator = torch.Generator().manual_seed(3)
    phase = torch.randn(3, 24, 24, generator=generator, dtype=torch.float64)
    level = torch.rand(24, 24, generator=generator, dtype=torch.float64)
    arguments = {
        "pitch_um": 0.4,
        "sensor_distance_um": 60.0,
        "window_um": 8.0,
        "samples": 6,
        "tolerance": 1e-6,
        "wavelength_um": [0.80, 0.85, 0.90],
        "depths_um": [900.0, 1500.0],
    }
    arguments |= {} if weights is None else {"weights": weights}
    parts = [parallel._by_wavelength(phase, level, part, 3, arguments) for part in (slice(0, 2), slice(2, 3))]
    one = parallel.psf_stack(phase, level, **arguments)
    light = sum(part.intensity * part.energy_um2[..., None, None] for part in parts)
    energy = sum(part.energy_um2 for part in parts)
    assert torch.allclose(energy, one.energy_um2, rtol=1e-5)
    assert torch.allclose(light / energy[..., None, None], one.intensity, atol=1e-5 * float(one.intensity.max()))
    assert np.allclose(parts[0].weights, np.full(3, 1 / 3) if weights is None else np.array(weights) / 6)
