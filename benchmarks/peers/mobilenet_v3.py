"""MobileNetV3 (Howard et al. 2019, Tables 1 and 2) by the rules that count our
networks: its count is published.
"""

from codesign.network.architecture import BlockSpec, round_channels
from codesign.network.cost import MacPolynomial, backbone_cost


def counted(variant: str, *, size: int = 224, classes: int = 1000) -> int:
    """Multiply-accumulates of the variant small or large for square pictures of
    ``size`` pixels in three colours.
    """
    rows, last, hidden = _MOBILENETS[variant]
    inputs, chain = 16, []
    for kernel, wide, outputs, squeeze, stride in rows:
        chain.append(
            BlockSpec(
                kernel,
                inputs,
                wide,
                outputs,
                stride,
                round_channels(wide / 4) if squeeze else 0,
                "relu",
            )
        )
        inputs = outputs
    body = backbone_cost(16, chain, inputs=3)
    end = max(body.per_pixel)
    per_pixel = dict(body.per_pixel) | {end: body.per_pixel[end] + inputs * last}
    return int(
        MacPolynomial(per_pixel, body.constant + last * hidden + hidden * classes).at(
            size
        )
    )


# kernel, expanded channels, output channels, squeeze-and-excitation, stride
_MOBILENETS: dict[str, tuple[list[tuple[int, int, int, bool, int]], int, int]] = {
    "large": (
        [
            (3, 16, 16, False, 1),
            (3, 64, 24, False, 2),
            (3, 72, 24, False, 1),
            (5, 72, 40, True, 2),
            (5, 120, 40, True, 1),
            (5, 120, 40, True, 1),
            (3, 240, 80, False, 2),
            (3, 200, 80, False, 1),
            (3, 184, 80, False, 1),
            (3, 184, 80, False, 1),
            (3, 480, 112, True, 1),
            (3, 672, 112, True, 1),
            (5, 672, 160, True, 2),
            (5, 960, 160, True, 1),
            (5, 960, 160, True, 1),
        ],
        960,
        1280,
    ),
    "small": (
        [
            (3, 16, 16, True, 2),
            (3, 72, 24, False, 2),
            (3, 88, 24, False, 1),
            (5, 96, 40, True, 2),
            (5, 240, 40, True, 1),
            (5, 240, 40, True, 1),
            (5, 120, 48, True, 1),
            (5, 144, 48, True, 1),
            (5, 288, 96, True, 2),
            (5, 576, 96, True, 1),
            (5, 576, 96, True, 1),
        ],
        576,
        1024,
    ),
}
