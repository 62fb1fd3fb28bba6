"""Training: fixed seeds, a moving average of the weights, checkpoints to go on from."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import torch
from augmentation import Crops
from losses import LossOptions, loss
from muon import Muon
from network import STRIDE, AnyRoadNet, PretrainedRoadNet, RoadNet
from numpy.typing import NDArray
from tiles import Tile
from torch import Tensor

__all__ = ["RECIPES", "TrainingOptions", "make_network", "probabilities", "train"]

Optimizers = tuple[torch.optim.Optimizer, ...]


@dataclass(frozen=True)
class TrainingOptions:
    """How long and how fast."""

    network: str = "pretrained"  # or "plain"
    steps: int = 3800
    batch: int = 4
    size: int = 384  # px of a crop
    rate: float = 2e-3
    decay: float = 0.02
    seed: int = 0
    average: float = 0.998
    device: str = "cpu"
    start: Path | None = None  # a checkpoint whose averaged weights are begun with
    save_every: int = 50


@dataclass(frozen=True)
class Recipe:
    """How a network is trained best, as far as it was tried."""

    scales: tuple[float, float]  # metres per pixel of most crops
    doubt: float  # see `LossOptions`
    gently: float  # how much slower the first layers learn


#: An encoder that knows pictures learns roads slowly, or it forgets them.
RECIPES = {"plain": Recipe((1.1, 2.0), 0.6, 1.0), "pretrained": Recipe((0.8, 1.6), 0.2, 0.25)}


def make_network(kind: str) -> AnyRoadNet:
    """Return a network that knows nothing."""
    return PretrainedRoadNet() if kind == "pretrained" else RoadNet()


def train(tiles: list[Tile], checkpoint: Path, options: TrainingOptions) -> AnyRoadNet:
    """Train on `tiles`, or go on from `checkpoint`; return the network of averaged weights, ready to predict."""
    torch.manual_seed(options.seed)
    cv2.setNumThreads(1)
    recipe, network = RECIPES[options.network], make_network(options.network)
    if isinstance(network, PretrainedRoadNet) and not (checkpoint.exists() or options.start):
        network.encoder.begin_with_imagenet()
    network = network.to(options.device, memory_format=torch.channels_last)
    if options.start:
        network.load_state_dict(torch.load(options.start, map_location=options.device, weights_only=True)["mean"])
    mean = copy.deepcopy(network).eval()
    optimizers = _optimizers(network, options)
    first = _resume(checkpoint, network, mean, optimizers, options)
    batches, log = _batches(tiles, first, options), _Log(checkpoint.with_suffix(".log"), options.steps)
    for step in range(first, options.steps):
        for i, optimizer in enumerate(optimizers):
            slower = recipe.gently if i == 0 else 1.0
            for group in optimizer.param_groups:
                group["lr"] = slower * options.rate * _schedule(step / options.steps)
        parts = _step(network, optimizers, next(batches), (step / options.steps, recipe.doubt), options.device)
        _average(mean, network, min(options.average, (1 + step) / (10 + step)))
        log.add(step, parts)
        if (step + 1) % options.save_every == 0 or step + 1 == options.steps:
            _save(checkpoint, network, mean, optimizers, step + 1)
    return mean.eval()


@torch.no_grad()
def probabilities(network: AnyRoadNet, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the probability of road, (H, W), of a whole photograph (H, W, 3); its border is mirrored to fill up."""
    h, w = photo.shape[:2]
    margins = ((0, -h % STRIDE), (0, -w % STRIDE), (0, 0))
    padded = np.pad(photo, margins, mode="reflect").astype(np.float32) / 255
    device = next(network.parameters()).device
    image = torch.from_numpy(padded).permute(2, 0, 1)[None].to(device, memory_format=torch.channels_last)
    with torch.autocast(device.type, torch.bfloat16, enabled=_quick_in_16_bits(device.type)):
        road = network.eval()(image)["road"]
    return road.float().sigmoid()[0, 0, :h, :w].cpu().numpy()


def _step(
    network: AnyRoadNet, optimizers: Optimizers, batch: tuple[Tensor, Tensor], doubted: tuple[float, float], device: str
) -> dict[str, float]:
    photo, truth = (t.to(device) for t in batch)
    with torch.autocast(device, torch.bfloat16, enabled=_quick_in_16_bits(device)):
        output = network.train()(photo)
    # A map without a road is doubted only by a network that has learnt what roads are.
    done, doubt = doubted
    parts = loss(output, truth, doubt=min(max((done - 0.3) / 0.3, 0.0), 1.0), options=LossOptions(doubt=doubt))
    network.zero_grad(set_to_none=True)
    sum(parts.values()).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
    for optimizer in optimizers:
        optimizer.step()
    return {name: float(part.detach()) for name, part in parts.items()}


@cache
def _quick_in_16_bits(device: str) -> bool:
    """Return whether the device multiplies in bfloat16: processors that only feign it take ten times as long."""
    if device != "cpu":
        return True
    took = {}
    for kind in (torch.float32, torch.bfloat16):
        matrix = torch.ones(512, 512, dtype=kind)
        runs = []
        for _ in range(5):
            started = time.perf_counter()
            matrix @ matrix
            runs.append(time.perf_counter() - started)
        took[kind] = min(runs)
    return took[torch.bfloat16] < 0.8 * took[torch.float32]


def _batches(tiles: list[Tile], first: int, options: TrainingOptions) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield photographs (N, 3, S, S) and truths (N, 4, S, S).

    Step n draws the same crops whether or not training was interrupted.
    """
    crops = Crops(tiles, options.size, RECIPES[options.network].scales)
    step = first
    while True:
        rng = np.random.default_rng((options.seed, step))
        photos, truths = zip(*(crops.draw(rng) for _ in range(options.batch)), strict=True)
        yield (
            torch.from_numpy(np.stack(photos)).permute(0, 3, 1, 2),
            torch.from_numpy(np.stack(truths)).permute(0, 3, 1, 2).contiguous(),
        )
        step += 1


def _schedule(done: float, warmup: float = 0.03, fall: float = 0.65) -> float:
    """Return the learning rate as a share of the largest: up, level, and from `fall` on down to nothing.

    The level middle lets a run that was cut short go on with fewer or more steps than it was begun with.
    """
    if done < warmup:
        return done / warmup + 1e-3
    return 1.0 if done < fall else 0.5 * (1 + math.cos(math.pi * (done - fall) / (1 - fall)))


def _optimizers(network: AnyRoadNet, options: TrainingOptions) -> Optimizers:
    """Return Adam for the first layers, Muon for the kernels between them and the last layers, Adam for all else."""
    first = list(network.first.parameters())
    ends = {id(p) for part in (network.first, network.heads) for p in part.parameters()}
    inner = [p for p in network.parameters() if p.ndim == 4 and id(p) not in ends]
    known = {id(p) for p in (*first, *inner)}
    others = [p for p in network.parameters() if id(p) not in known]
    return (
        torch.optim.AdamW(first, options.rate, weight_decay=options.decay),
        Muon(inner, options.rate, options.decay),
        torch.optim.AdamW(others, options.rate, weight_decay=0.0),
    )


@torch.no_grad()
def _average(mean: AnyRoadNet, network: AnyRoadNet, keep: float) -> None:
    theirs = network.state_dict()
    for name, value in mean.state_dict().items():
        if value.dtype.is_floating_point:
            value.lerp_(theirs[name], 1 - keep)


def _save(path: Path, network: AnyRoadNet, mean: AnyRoadNet, optimizers: Optimizers, step: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {
        "network": network.state_dict(),
        "mean": mean.state_dict(),
        "optimizers": [o.state_dict() for o in optimizers],
        "step": step,
    }
    partial = path.with_suffix(".part")
    torch.save(state, partial)
    partial.replace(path)


def _resume(path: Path, network: AnyRoadNet, mean: AnyRoadNet, optimizers: Optimizers, options: TrainingOptions) -> int:
    if not path.exists():
        return 0
    state = torch.load(path, map_location=options.device, weights_only=True)
    network.load_state_dict(state["network"])
    mean.load_state_dict(state["mean"])
    for optimizer, saved in zip(optimizers, state["optimizers"], strict=True):
        optimizer.load_state_dict(saved)
    return int(state["step"])


class _Log:
    """Prints the mean of the parts of the loss every 50 steps."""

    def __init__(self, path: Path, steps: int) -> None:
        self.path, self.steps, self.sums, self.n, self.started = path, steps, {}, 0, time.monotonic()

    def add(self, step: int, parts: dict[str, float]) -> None:
        for name, value in parts.items():
            self.sums[name] = self.sums.get(name, 0.0) + value
        self.n += 1
        if (step + 1) % 50 and step + 1 != self.steps:
            return
        text = "  ".join(f"{name} {value / self.n:.3f}" for name, value in self.sums.items())
        line = f"step {step + 1}/{self.steps}  {(time.monotonic() - self.started) / self.n:.2f} s/step  {text}"
        print(line, flush=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as out:
            out.write(line + "\n")
        self.sums, self.n, self.started = {}, 0, time.monotonic()
