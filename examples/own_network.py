"""Your own network and loss behind a lens whose phase is trained along with it."""

import torch

from codesign.batches import EyeScenes, SceneConfig, sensor_irradiance
from codesign.optics import OpticsConfig
from codesign.optics.stack import lens_psf_stack, stack_imager
from codesign.train.imaging import read_out
from metalens.image import Sensor

lens = OpticsConfig(image="uniform", polynomials=8, sample_um=24.0, window_samples=17)
scenes = EyeScenes(SceneConfig(pixels=48, margin=8), lens.sample_um, 2000.0, seed=0)
pitch_um = torch.tensor(lens.sample_um)


def train(
    network: torch.nn.Module, steps: int = 20
) -> tuple[torch.Tensor, list[float]]:
    """Phase coefficients of the lens, rad, and the loss of every step."""
    phase_rad = torch.zeros(lens.polynomials, dtype=torch.float64, requires_grad=True)
    optimiser = torch.optim.Adam([phase_rad, *network.parameters()], lr=3e-3)
    batch, losses = scenes.batch(0, 16), []
    for _ in range(steps):
        psfs = lens_psf_stack(lens, phase_rad)
        optics = stack_imager(lens, psfs, 64, margin=8)
        light = sensor_irradiance(batch.frames, optics)
        frames = read_out(light, 24.0, pitch_um, Sensor(), generator=None)
        loss = (network(frames) - batch.slip_mm).abs().mean()  # yours
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        losses.append(float(loss.detach()))
    return phase_rad.detach(), losses


if __name__ == "__main__":
    layers = torch.nn.Conv2d(1, 8, 5, stride=4), torch.nn.ReLU(), torch.nn.Flatten()
    print(train(torch.nn.Sequential(*layers, torch.nn.LazyLinear(3))))
