"""Losses for labels drawn from maps: some metres off, some roads missing, and broken roads worse than wide ones."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional

__all__ = ["LossOptions", "heading_of", "loss"]


@dataclass(frozen=True)
class LossOptions:
    """Weights of the parts of the loss."""

    dice: float = 0.5
    centre: float = 0.3  # skeleton recall (Kirchhoff et al., ECCV 2024): the share of the centre lines that is lost
    intersection: float = 0.3
    heading: float = 0.25
    coarse: float = 0.3
    void: float = 0.3  # weight of ground without a photograph: no road there, nor along its edge
    edge: float = 0.5  # weight of pixels beside a road's edge: labels are some metres off
    doubt: float = 0.6  # how far a sure "road" outweighs a map without it, once the network is trained a while


def loss(output: dict[str, Tensor], truth: Tensor, doubt: float, options: LossOptions) -> dict[str, Tensor]:
    """Return the parts of the loss, weighted; their sum is to be minimised.

    `truth` is (N, 5, H, W) as in `Tile.truth`, 0..1. `doubt` grows from 0 to 1 in training.
    """
    road, observed, centre, near, known = truth.float().split(1, dim=1)
    observed, known = (observed > 0.9).float(), (known > 0.9).float()
    road, centre, near = road * observed, centre * observed, near * observed
    seen = known * (observed + options.void * (1 - observed))
    logits = output["road"].float()
    chance = logits.sigmoid()
    weight = seen * _trust(chance.detach(), road, options.edge, doubt * options.doubt)
    parts = {
        "road": _mean(functional.binary_cross_entropy_with_logits(logits, road, reduction="none"), weight),
        "dice": options.dice * _dice(chance, road, weight),
        "centre": options.centre * (1 - (chance * centre).sum() / (centre.sum() + 100)),
    }
    return parts | _auxiliary(output, (road, observed * known, near), options)


def heading_of(road: Tensor) -> tuple[Tensor, Tensor]:
    """Return (N, 2, h, w) cosine and sine of twice the roads' angle, and (N, 1, h, w) how sure they are, 0..1.

    From the structure tensor of the smoothed mask: a road's brightness changes across it, so it runs at right angles.
    """
    smooth = functional.avg_pool2d(road, 3, 1, 1)
    dx, dy = (
        functional.pad(smooth, (1, 1, 0, 0))[..., 2:] - functional.pad(smooth, (1, 1, 0, 0))[..., :-2],
        functional.pad(smooth, (0, 0, 1, 1))[..., 2:, :] - functional.pad(smooth, (0, 0, 1, 1))[..., :-2, :],
    )
    tensor = functional.avg_pool2d(torch.cat([dy * dy - dx * dx, -2 * dx * dy, dx * dx + dy * dy], 1), 5, 1, 2)
    doubled, power = tensor[:, :2], tensor[:, 2:]
    length = doubled.norm(dim=1, keepdim=True)
    return doubled / length.clamp(min=1e-6), length / power.clamp(min=1e-6) * (power > 1e-4)


def _auxiliary(
    output: dict[str, Tensor], truth: tuple[Tensor, Tensor, Tensor], options: LossOptions
) -> dict[str, Tensor]:
    road, observed, near = truth
    seen = observed[..., ::4, ::4]
    peaks = functional.avg_pool2d(near, 4)
    quarter = functional.avg_pool2d(road, 4)
    heading, sure = heading_of(quarter)
    eighth = functional.avg_pool2d(quarter, 2)
    by_heading = (output["heading"].float() - heading).abs().sum(1, keepdim=True)
    by_peak = functional.binary_cross_entropy_with_logits(output["intersection"].float(), peaks, reduction="none")
    coarse = functional.binary_cross_entropy_with_logits(output["coarse"].float(), eighth, reduction="none")
    return {
        "intersection": options.intersection * _mean(by_peak * (1 + 9 * peaks), seen),
        "heading": options.heading * _mean(by_heading, seen * sure * (quarter > 0.1)),
        "coarse": options.coarse * _mean(coarse, observed[..., ::8, ::8]),
    }


def _trust(chance: Tensor, road: Tensor, edge: float, doubt: float) -> Tensor:
    """Return how far each pixel's label is to be believed."""
    band = functional.max_pool2d(road, 3, 1, 1) + functional.max_pool2d(-road, 3, 1, 1)
    trust = 1 - (1 - edge) * band
    return trust * (1 - doubt * (1 - road) * chance.square()) if doubt else trust


def _dice(chance: Tensor, road: Tensor, weight: Tensor) -> Tensor:
    overlap = (weight * chance * road).sum()
    return 1 - (2 * overlap + 100) / ((weight * (chance + road)).sum() + 100)


def _mean(values: Tensor, weight: Tensor) -> Tensor:
    return (values * weight).sum() / weight.sum().clamp(min=1)
