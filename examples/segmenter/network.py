"""Two networks, U-Nets whose deep stages look far, for roads are told by where they lead.

They err in different places: one knows nothing but roads, the other has an encoder that has seen pictures of all sorts.
"""

from __future__ import annotations

from typing import TypeAlias

import torch
from encoder import WIDTHS, Encoder
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["STRIDE", "AnyRoadNet", "PretrainedRoadNet", "RoadNet", "Roads"]

STRIDE = 32  # height and width must be multiples of this


def convolution(n_in: int, n_out: int, size: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    """Convolution, batch normalisation, ReLU."""
    padding = dilation * (size // 2)
    return nn.Sequential(
        nn.Conv2d(n_in, n_out, size, stride, padding, dilation, bias=False),
        nn.BatchNorm2d(n_out),
        nn.ReLU(inplace=True),
    )


class Residual(nn.Module):
    """Two 3 x 3 convolutions beside a short cut (He et al. 2016)."""

    def __init__(self, n: int, dilations: tuple[int, int] = (1, 1)) -> None:
        super().__init__()
        self.first = convolution(n, n, dilation=dilations[0])
        self.second = nn.Conv2d(n, n, 3, padding=dilations[1], dilation=dilations[1], bias=False)
        self.norm = nn.BatchNorm2d(n)
        nn.init.zeros_(self.norm.weight)

    def forward(self, x: Tensor) -> Tensor:
        return functional.relu(x + self.norm(self.second(self.first(x))), inplace=True)


class Up(nn.Module):
    """Twice the size, joined with the encoder's features of that size."""

    def __init__(self, n_deep: int, n_skip: int, n: int) -> None:
        super().__init__()
        self.narrow = nn.Conv2d(n_deep, n, 1, bias=False)
        self.skip = nn.Conv2d(n_skip, n, 1, bias=False)
        self.norm = nn.BatchNorm2d(n)
        self.blend = convolution(n, n)

    def forward(self, deep: Tensor, skip: Tensor) -> Tensor:
        larger = functional.interpolate(self.narrow(deep), scale_factor=2, mode="bilinear", align_corners=False)
        return self.blend(functional.relu(self.norm(larger + self.skip(skip))))


class Heads(nn.Module):
    """The last layers, each of which gives logits.

    `road` is what is shipped. `intersection` and `heading` (cosine and sine of twice the road's angle; Batra et al.,
    CVPR 2019) exist for training: they make the network join the pieces of a road.
    """

    def __init__(self, n_last: int, n_quarter: int, n_eighth: int, shuffled: int) -> None:
        super().__init__()
        self.road = nn.Sequential(nn.Conv2d(n_last, shuffled**2, 3, padding=1), nn.PixelShuffle(shuffled))
        self.intersection = nn.Conv2d(n_quarter, 1, 3, padding=1)
        self.heading = nn.Conv2d(n_quarter, 2, 3, padding=1)
        self.coarse = nn.Conv2d(n_eighth, 1, 1)
        nn.init.constant_(self.road[0].bias, -2.5)
        with torch.no_grad():  # the pixels of a cell begin alike (ICNR, Aitken et al. 2017): no chequered pattern
            self.road[0].weight.copy_(self.road[0].weight[:1].expand_as(self.road[0].weight).clone())
        nn.init.constant_(self.coarse.bias, -2.5)
        nn.init.constant_(self.intersection.bias, -4.0)

    def forward(self, last: Tensor, quarter: Tensor, eighth: Tensor) -> dict[str, Tensor]:
        return {
            "road": self.road(last),  # (N, 1, H, W): channels of smaller features are shuffled into place
            "intersection": self.intersection(quarter),  # (N, 1, H/4, W/4)
            "heading": self.heading(quarter),  # (N, 2, H/4, W/4)
            "coarse": self.coarse(eighth),  # (N, 1, H/8, W/8): deep supervision
        }


class RoadNet(nn.Module):
    """RGB (N, 3, H, W), 0..1, to logits (see `Heads`); H and W multiples of 16.

    Most of the arithmetic is done at 1/4 to 1/16 of the photograph's size, where it is cheap. Dilated convolutions at
    1/16 see about 1 km at 1 m per pixel: enough to carry a road through trees and shadows.
    """

    MEAN, STD = (0.35, 0.36, 0.33), (0.2, 0.2, 0.2)

    def __init__(self, widths: tuple[int, int, int, int] = (24, 48, 96, 160)) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        self.register_buffer("mean", torch.tensor(self.MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(self.STD).view(1, 3, 1, 1), persistent=False)
        self.stem = convolution(3, half, size=5, stride=2)
        self.quarter = nn.Sequential(convolution(half, quarter, stride=2), Residual(quarter), Residual(quarter))
        self.eighth = nn.Sequential(convolution(quarter, eighth, stride=2), Residual(eighth), Residual(eighth))
        self.sixteenth = nn.Sequential(
            convolution(eighth, sixteenth, stride=2),
            nn.Dropout2d(0.1),
            Residual(sixteenth, (1, 2)),
            Residual(sixteenth, (4, 8)),
            Residual(sixteenth, (2, 1)),
        )
        self.up_eighth, self.up_quarter = Up(sixteenth, eighth, eighth), Up(eighth, quarter, quarter)
        self.heads = Heads(quarter, quarter, eighth, 4)

    @property
    def first(self) -> nn.Module:
        """What comes before the layers that Muon trains."""
        return self.stem

    def forward(self, image: Tensor) -> dict[str, Tensor]:
        quarter = self.quarter(self.stem((image - self.mean) / self.std))
        eighth = self.eighth(quarter)
        eighth = self.up_eighth(self.sixteenth(eighth), eighth)
        quarter = self.up_quarter(eighth, quarter)
        return self.heads(quarter, quarter, eighth)


class PretrainedRoadNet(nn.Module):
    """As `RoadNet`, on an encoder that is begun with weights from ImageNet, and with features at half the size."""

    def __init__(self, widths: tuple[int, int, int, int] = (24, 48, 64, 96)) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        self.encoder = Encoder()
        self.up_sixteenth = Up(WIDTHS[4], WIDTHS[3], sixteenth)
        self.far = nn.Sequential(nn.Dropout2d(0.1), Residual(sixteenth, (2, 4)))
        self.up_eighth = Up(sixteenth, WIDTHS[2], eighth)
        self.up_quarter = Up(eighth, WIDTHS[1], quarter)
        self.up_half = Up(quarter, WIDTHS[0], half)
        self.heads = Heads(half, quarter, eighth, 2)

    @property
    def first(self) -> nn.Module:
        """What comes before the layers that Muon trains: the encoder, which is not begun from chance."""
        return self.encoder

    def forward(self, image: Tensor) -> dict[str, Tensor]:
        halves, quarters, eighths, sixteenths, deep = self.encoder(2 * image - 1)
        eighth = self.up_eighth(self.far(self.up_sixteenth(deep, sixteenths)), eighths)
        quarter = self.up_quarter(eighth, quarters)
        return self.heads(self.up_half(quarter, halves), quarter, eighth)


AnyRoadNet: TypeAlias = RoadNet | PretrainedRoadNet


class Roads(nn.Module):
    """What is exported: RGB to the probability of road, (N, 1, H, W)."""

    def __init__(self, network: AnyRoadNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        return torch.sigmoid(self.network(image)["road"])
