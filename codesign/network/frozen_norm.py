"""Normalisation by what was seen before: the batch itself moves nothing."""

import torch
from torch import Tensor, nn

from codesign.batches import parallel

REACH = 100  # batches that the means reach back over
# added to the variance: a wave that is rare in frames is not amplified without bound
EPSILON = 1e-2


class RunningNorm(nn.Module):
    """(x - m) / sqrt(v + EPSILON) a channel, m and v those of the last batches, this
    one included.

    Of n batches the n-th has a share of 1 / n, from REACH batches on of 1 / REACH.
    Gradients do not go through m and v.
    Evaluation moves nothing, nor does a batch that is not finite. In double precision:
    a power's mean is many times its
    spread, and the difference of squares would leave four digits.
    """

    mean: Tensor
    square: Tensor
    batches: Tensor

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(channels, dtype=torch.float64))
        self.register_buffer(
            "square", torch.ones(channels, dtype=torch.float64)
        )  # mean of x^2
        self.register_buffer("batches", torch.zeros((), dtype=torch.int64))

    def forward(self, x: Tensor) -> Tensor:
        if self.training:
            self._follow(x)
        scale = torch.rsqrt((self.square - self.mean**2).clamp_min(0) + EPSILON)
        return (x - self.mean.to(x)[:, None, None]) * scale.to(x)[:, None, None]

    @torch.no_grad()
    def _follow(self, x: Tensor) -> None:
        """Update the running moments by a batch; unchanged where it is not finite."""
        values = x.double()
        moments = torch.stack([values.mean((0, 2, 3)), (values**2).mean((0, 2, 3))])
        if parallel.process_count() > 1:
            moments = (
                torch.tensor(parallel.mean_of(moments.flatten().tolist()))
                .to(moments)
                .view_as(moments)
            )
        if bool(torch.isfinite(moments).all()):
            self.batches += 1
            share = 1 / min(int(self.batches), REACH)
            self.mean.lerp_(moments[0], share)
            self.square.lerp_(moments[1], share)
