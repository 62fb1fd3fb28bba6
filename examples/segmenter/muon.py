"""Muon: steps of equal size in all directions of a layer; small networks learn in fewer of them than of Adam's."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

__all__ = ["Muon"]


class Muon(torch.optim.Optimizer):
    """Momentum, orthogonalised (Jordan et al. 2024), scaled as large as Adam's steps (Liu et al. 2025, eq. 4).

    For kernels of convolutions, (n_out, n_in, k, k), taken as matrices of n_out rows.
    """

    def __init__(self, kernels: Iterable[Tensor], lr: float, weight_decay: float, momentum: float = 0.95) -> None:
        super().__init__(kernels, {"lr": lr, "weight_decay": weight_decay, "momentum": momentum})

    @torch.no_grad()
    def step(self) -> None:  # type: ignore[override]
        for group in self.param_groups:
            for kernel in group["params"]:
                if kernel.grad is None:
                    continue
                state = self.state[kernel]
                velocity = state.setdefault("velocity", torch.zeros_like(kernel))
                velocity.lerp_(kernel.grad, 1 - group["momentum"])
                ahead = kernel.grad.lerp(velocity, group["momentum"]).flatten(1)  # Nesterov
                step = orthogonalise(ahead).view_as(kernel) * (0.2 * max(ahead.shape) ** 0.5)
                kernel.mul_(1 - group["lr"] * group["weight_decay"]).sub_(group["lr"] * step)


def orthogonalise(matrix: Tensor, rounds: int = 5) -> Tensor:
    """Return nearly U V' of the matrix U S V', by Newton and Schulz's iteration with Jordan's coefficients."""
    a, b, c = 3.4445, -4.7750, 2.0315
    x = matrix.bfloat16()
    tall = x.shape[0] > x.shape[1]
    x = (x.T if tall else x) / (x.norm() + 1e-7)
    for _ in range(rounds):
        gram = x @ x.T
        x = a * x + (b * gram + c * gram @ gram) @ x
    return (x.T if tall else x).to(matrix.dtype)
