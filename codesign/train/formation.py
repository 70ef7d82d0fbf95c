"""From light on the image grid to what the network sees and what it costs, and the
depth that a PSF stack tells.
"""

from dataclasses import replace

import torch
from torch import Tensor

from codesign.batches import parallel
from codesign.network import Architecture, Supernet, cost
from codesign.optics import OpticsConfig, PixelPsfStack
from metalens.image import Sensor, encircled_energy, texture_information
from metalens.image import sensor as camera
from metalens.psf import pixel_count


def read_out(
    irradiance: Tensor,
    sample_um: float,
    pitch_um: Tensor,
    sensor: Sensor,
    *,
    generator: torch.Generator | None,
    exact: bool = True,
    resized: bool = False,
    quiet: bool = False,
) -> Tensor:
    """(batch, 1, rows, columns) standardised frames as the network sees them: pixels,
    noise, quantisation.

    The gradient in the pitch is that of a network whose own grid stays on the scene, so
    of a fixed cost: the box of the
    pixels widens, and an area of the sensor is read (pitch0 / pitch)^2 times; its light
    and photon noise stay. (The
    frame as such zooms while its pixels grow, until one drops off at the rim: a slope
    that says nothing of the next
    count of pixels.)

    Args:
        exact: Poisson counts; otherwise their normal approximation, four times faster
            (the skewness 1 / sqrt(mean)
            is lost), still Poisson where the mean is below 20 electrons.
        resized: the frames will be averaged to a coarser grid, whose cells, not the
            pixels, are then the box: the
            gradient in the pitch is that of the reads alone.
        quiet: the expected electrons, without noise.
        irradiance: (batch, y, x) light on the image grid.
        sample_um: distance of the samples. pitch_um: () pitch of the pixels, um.
        generator: of the draws.
    """
    here, moves = float(pitch_um.detach()), pitch_um.requires_grad
    pixel = replace(sensor, pitch_um=here)  # the full well is that of this pitch
    box, grid_um = (
        (pitch_um, here) if moves and not resized else (pitch_um.detach(), None)
    )
    mean = camera.mean_electrons(
        irradiance, sample_um, sensor=pixel, pitch_um=box, grid_um=grid_um
    )
    reads = (here / pitch_um) ** 2
    if quiet:
        electrons = mean.clamp(
            max=pixel.full_well_e * float(camera.kappa(here, pixel.base_pitch_um))
        )
    elif not exact and float(mean.detach().mean()) > 20:
        electrons = _normal(mean, pixel, generator, reads)
    else:
        electrons = camera.expose(mean, sensor=pixel, generator=generator, reads=reads)
    frames = camera.digitise(electrons, sensor=pixel)
    centred = frames - frames.mean((-2, -1), keepdim=True)
    count = centred.shape[-2] * centred.shape[-1]
    deviation = (
        ((centred * centred).sum((-2, -1), keepdim=True) / max(count - 1, 1))
        .clamp_min(1e-12)
        .sqrt()
    )
    return (centred / deviation)[:, None].to(torch.float32)


def _normal(
    mean: Tensor, sensor: Sensor, generator: torch.Generator | None, reads: Tensor
) -> Tensor:
    """Electrons of mean and variance as :func:`metalens.image.expose`, up to the full
    well, from one normal draw.
    """
    well = sensor.full_well_e * float(
        camera.kappa(sensor.pitch_um, sensor.base_pitch_um)
    )
    collected = mean.clamp(max=well)
    share, size = (
        parallel.process_count(),
        len(mean),
    )  # the noise of the whole batch, whoever takes which part of it
    noise = camera.normal((share * size, *mean.shape[1:]), mean, generator)
    noise = noise[parallel.process_rank() * size : (parallel.process_rank() + 1) * size]
    return collected + noise * torch.sqrt(
        collected + sensor.read_noise_e**2 * reads.to(mean) + 1e-6
    )


def frame_wide(samples: int, sample_um: float, pitch_um: float) -> float:
    """Width of the sensor's frame over that of its image: 1, or more where the pixels
    do not divide the image.

    The last pixels then reach beyond the image, by half a pixel at most; a network sees
    the frame and tells places in
    it, so its labels are those of the frame
    (:func:`codesign.network.losses.mask_in_frame`).

    Args:
        samples: of the image along a side. sample_um: distance of the samples.
        pitch_um: of the pixels.
    """
    wide = pixel_count(samples, sample_um, pitch_um) * pitch_um / (samples * sample_um)
    return 1.0 if abs(wide - 1) < 1e-9 else wide


def network_macs(
    net: Supernet, architecture: Architecture, window_um: float, pitch_um: Tensor
) -> Tensor:
    """Multiply-accumulates of one member at this pitch, differentiable.

    Args:
        net: elastic network. architecture: member of the search space.
        window_um: edge of the image. pitch_um: () pitch of the pixels, um.
    """
    size = window_um / pitch_um * architecture.resolution
    return cost.interpolate_counts(lambda sizes: net.counts(architecture, sizes), size)


def depth_information(made: PixelPsfStack) -> Tensor:
    """(depths - 1,) information on depth between the depths, in the blur of a window of
    1/f texture, per mm².

    The window is as wide as the PSFs; the noise is a thousandth of the texture's mean
    power. One over its square root
    is the least standard deviation of any reader that knows the statistics of the
    texture and nothing else of it
    (:func:`metalens.fisher.texture_information`): readers of real frames collect less.

    Args:
        made: PSFs over depth.
    """
    psfs = made.intensity
    spectrum = _texture(psfs.shape[-1]).to(psfs)
    gaps = (made.depths_um[1:] - made.depths_um[:-1]).tolist()
    pairs = torch.stack([psfs[:-1], psfs[1:]], 1)
    told = [
        texture_information(pair, step_um=gap, spectrum=spectrum, noise=1e-3)[0]
        for pair, gap in zip(pairs, gaps, strict=True)
    ]
    return torch.stack(told)


def depth_loss(made: PixelPsfStack, settings: OpticsConfig, *, energy: float) -> Tensor:
    """-log of the information on depth in blurred texture, and a hinge on the encircled
    energy (paper Eq. 6).

    A texture's blur is what the network reads; the information of the PSF alone ranks
    lenses wrongly.

    Args:
        made: PSFs over depth. settings: of the lens and its image.
    """
    told, psfs = depth_information(made), made.intensity
    share = encircled_energy(psfs, settings.sample_um, radius_um=2 * settings.sample_um)
    return -torch.log(told + 0.05).mean() + 50 * torch.relu(energy - share).mean()


def _texture(size: int) -> Tensor:
    """Power of a 1/f texture on the grid of rfft2, of mean 1."""
    fy, fx = torch.fft.fftfreq(size), torch.fft.rfftfreq(size)
    power = 1 / (fy[:, None] ** 2 + fx**2 + (0.5 / size) ** 2)
    scaled: Tensor = power / power.mean()
    return scaled
