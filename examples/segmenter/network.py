"""The network: a U-Net on an encoder that knows pictures, whose deep stages look far."""

from __future__ import annotations

import torch
from encoder import WIDTHS, Encoder
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["STRIDE", "RoadNet", "Roads"]

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
    """RGB (N, 3, H, W), 0..1, to logits (see `Heads`); H and W multiples of 32.

    Features are kept at half the size and coarser. Dilated convolutions at 1/16 see about 1 km at 1 m per pixel: enough
    to carry a road through trees and shadows.
    """

    def __init__(self, widths: tuple[int, int, int, int] = (32, 64, 96, 160)) -> None:
        super().__init__()
        half, quarter, eighth, sixteenth = widths
        self.encoder = Encoder()
        self.up_sixteenth = Up(WIDTHS[4], WIDTHS[3], sixteenth)
        self.far = nn.Sequential(
            nn.Dropout2d(0.1),
            Residual(sixteenth, (1, 2)),
            Residual(sixteenth, (4, 8)),
            Residual(sixteenth, (2, 1)),
        )
        self.up_eighth = Up(sixteenth, WIDTHS[2], eighth)
        self.up_quarter = Up(eighth, WIDTHS[1], quarter)
        self.up_half = Up(quarter, WIDTHS[0], half)
        self.heads = Heads(half, quarter, eighth, 2)

    def forward(self, image: Tensor) -> dict[str, Tensor]:
        halves, quarters, eighths, sixteenths, deep = self.encoder(2 * image - 1)
        eighth = self.up_eighth(self.far(self.up_sixteenth(deep, sixteenths)), eighths)
        quarter = self.up_quarter(eighth, quarters)
        return self.heads(self.up_half(quarter, halves), quarter, eighth)


class Roads(nn.Module):
    """The exported network: RGB to the probability of road, (N, 1, H, W)."""

    def __init__(self, network: RoadNet) -> None:
        super().__init__()
        self.network = network

    def forward(self, image: Tensor) -> Tensor:
        return torch.sigmoid(self.network(image)["road"])
