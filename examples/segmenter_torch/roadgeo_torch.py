"""A segmenter for roadgeo that runs a TorchScript model of your own.

ROADGEO_TORCH_MODEL names a file that `torch.jit.save` wrote. Its model takes pictures (1, 3, H, W), RGB, 0 to 1, and
gives logits (1, 1, H, W) of road. A TorchScript file is a program: run only those you trust.
"""

import os
from functools import cache

import cv2
import numpy as np
import torch

TILE, OVERLAP = 1024, 128  # pixels


def find_roads(photo):
    """The probability of road at every pixel of a photograph: (H, W) float32."""
    picture = cv2.cvtColor(cv2.imread(str(photo)), cv2.COLOR_BGR2RGB)
    height, width = picture.shape[:2]
    total, count = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
    for top in range(0, max(height - OVERLAP, 1), TILE - OVERLAP):
        for left in range(0, max(width - OVERLAP, 1), TILE - OVERLAP):
            part = np.s_[top : top + TILE, left : left + TILE]
            total[part] += _run(picture[part])
            count[part] += 1
    return total / count


@torch.no_grad()
def _run(tile):
    height, width = tile.shape[:2]
    filled = cv2.copyMakeBorder(tile, 0, -height % 32, 0, -width % 32, cv2.BORDER_REFLECT_101)
    image = torch.from_numpy(filled).permute(2, 0, 1)[None].float() / 255
    return _model()(image).sigmoid()[0, 0, :height, :width].numpy()


@cache
def _model():
    if "ROADGEO_TORCH_MODEL" not in os.environ:
        raise ValueError("set ROADGEO_TORCH_MODEL to a TorchScript file that finds roads")
    return torch.jit.load(os.environ["ROADGEO_TORCH_MODEL"], map_location="cpu").eval()
