"""Training for a number of minutes: a moving average of the weights, checkpoints on the way."""

from __future__ import annotations

import copy
import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

import cv2
import numpy as np
import torch
from augmentation import Crops
from losses import LossOptions, loss
from muon import Muon
from network import STRIDE, RoadNet
from numpy.typing import NDArray
from painting import Painter, Streets, painted
from tiles import Tile
from torch import Tensor

__all__ = ["Training", "TrainingOptions", "begin", "load", "probabilities", "train"]

Optimizers = tuple[torch.optim.Optimizer, ...]


@dataclass(frozen=True)
class TrainingOptions:
    """How long and how fast."""

    minutes: float = 9.0
    steps: int | None = None  # a number of steps instead of minutes
    batch: int = 64
    size: int = 384  # px of a crop
    rate: float = 2e-3
    gently: float = 0.25  # how much slower the encoder learns, or it forgets pictures
    decay: float = 0.05
    doubt: float = 0.3  # see `LossOptions`
    average: float = 0.998
    seed: int = 0
    device: str = "cpu"
    painted: float = 0.6  # share of crops that are painted, wholly or in part
    scenes: int = 1024  # held at a time
    workers: int = 0  # processes that paint
    marks: tuple[float, ...] = (1.0,)  # shares of the time at which a checkpoint is kept


def train(tiles: list[Tile], streets: Streets | None, checkpoint: Path, options: TrainingOptions) -> RoadNet:
    """Train on `tiles` and painted scenes; return the network of averaged weights, ready to predict."""
    with begin(tiles, streets, checkpoint, options) as training:
        while training.clock.done < 1:
            training.step()
    return training.mean.eval()


@contextmanager
def begin(tiles: list[Tile], streets: Streets | None, checkpoint: Path, options: TrainingOptions) -> Iterator[Training]:
    """Yield a training that is stepped by hand; two that take turns share a device well."""
    cv2.setNumThreads(1)  # or processes that paint would wait for threads that they do not have
    size = min(768, *(min(tile.photo.shape[:2]) for tile in tiles))
    with painted(Painter(streets, tiles, size), options.workers, options.seed) as pictures:
        yield Training(tiles, pictures, size, checkpoint, options)


class Training:
    """A network that learns, and the mean of its weights on the way."""

    def __init__(
        self,
        tiles: list[Tile],
        pictures: Iterator[NDArray[np.uint8] | None],
        scene_size: int,
        checkpoint: Path,
        options: TrainingOptions,
    ) -> None:
        self.tiles, self.pictures, self.scene_size = tiles, pictures, scene_size
        self.checkpoint, self.options = checkpoint, options
        self.clock = _Clock(options, checkpoint)

    @cached_property
    def network(self) -> RoadNet:
        torch.manual_seed(self.options.seed)
        network = RoadNet()
        network.encoder.begin_with_imagenet()
        return network.to(self.options.device, memory_format=torch.channels_last)

    @cached_property
    def mean(self) -> RoadNet:
        return copy.deepcopy(self.network).eval()

    @cached_property
    def crops(self) -> Crops:
        options = self.options
        torch.backends.cudnn.benchmark = True
        return Crops(
            self.tiles,
            options.size,
            scenes=options.scenes,
            scene_size=self.scene_size,
            device=options.device,
            seed=options.seed,
        )

    @cached_property
    def optimizers(self) -> Optimizers:
        return _optimizers(self.network, self.options)

    def step(self) -> None:
        """Learn from a batch; keep the weights where that is due."""
        options, clock = self.options, self.clock
        for picture in self.pictures:
            if picture is not None:
                self.crops.put(picture)
            if picture is None or not options.workers:
                break
        batch, mean = self.crops.draw(options.batch, options.painted), self.mean
        for i, optimizer in enumerate(self.optimizers):
            for group in optimizer.param_groups:
                group["lr"] = (options.gently if i == 0 else 1.0) * options.rate * _schedule(clock.done)
        parts = _step(self.network, self.optimizers, batch, clock.done, options)
        _average(mean, self.network, min(options.average, (1 + clock.step) / (10 + clock.step)))
        for mark in clock.tick(parts, self.crops.n_put):
            last = mark == max(options.marks)
            name = self.checkpoint.name if last else f"{self.checkpoint.stem}_{round(100 * mark)}.pt"
            _save(self.checkpoint.with_name(name), mean)


def load(checkpoint: Path, device: str = "cpu") -> RoadNet:
    """Return the network that a checkpoint holds."""
    network = RoadNet()
    state = torch.load(checkpoint, map_location="cpu", weights_only=True)
    network.load_state_dict({name: value.float() for name, value in state.items()})
    return network.eval().to(device, memory_format=torch.channels_last)


@torch.no_grad()
def probabilities(network: RoadNet, photo: NDArray[np.uint8]) -> NDArray[np.float32]:
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
    network: RoadNet, optimizers: Optimizers, batch: tuple[Tensor, Tensor], done: float, options: TrainingOptions
) -> dict[str, Tensor]:
    photo, truth = batch
    with torch.autocast(options.device, torch.bfloat16, enabled=_quick_in_16_bits(options.device)):
        output = network.train()(photo.to(memory_format=torch.channels_last))
    # A map without a road is doubted only by a network that has learnt what roads are.
    doubt = min(max((done - 0.3) / 0.3, 0.0), 1.0)
    parts = loss(output, truth, doubt=doubt, options=LossOptions(doubt=options.doubt))
    network.zero_grad(set_to_none=True)
    sum(parts.values()).backward()
    torch.nn.utils.clip_grad_norm_(network.parameters(), 2.0)
    for optimizer in optimizers:
        optimizer.step()
    return {name: part.detach() for name, part in parts.items()}


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


def _schedule(done: float, warmup: float = 0.03, fall: float = 0.4) -> float:
    """Return the learning rate as a share of the largest: up, level, and from `fall` on down to nothing."""
    if done < warmup:
        return done / warmup + 1e-3
    return 1.0 if done < fall else 0.5 * (1 + math.cos(math.pi * (done - fall) / (1 - fall)))


def _optimizers(network: RoadNet, options: TrainingOptions) -> Optimizers:
    """Return Adam for the encoder, Muon for the kernels between it and the last layers, Adam for all else."""
    first = list(network.encoder.parameters())
    ends = {id(p) for part in (network.encoder, network.heads) for p in part.parameters()}
    inner = [p for p in network.parameters() if p.ndim == 4 and id(p) not in ends]
    known = {id(p) for p in (*first, *inner)}
    others = [p for p in network.parameters() if id(p) not in known]
    fused = options.device != "cpu"
    return (
        torch.optim.AdamW(first, options.rate, weight_decay=options.decay, fused=fused),
        Muon(inner, options.rate, options.decay),
        torch.optim.AdamW(others, options.rate, weight_decay=0.0, fused=fused),
    )


@torch.no_grad()
def _average(mean: RoadNet, network: RoadNet, keep: float) -> None:
    pairs = zip(mean.state_dict().values(), network.state_dict().values(), strict=True)
    ours, theirs = zip(*(pair for pair in pairs if pair[0].dtype.is_floating_point), strict=True)
    torch._foreach_lerp_(ours, theirs, 1 - keep)


def _save(path: Path, network: RoadNet) -> None:
    """Keep the weights, the kernels' in 16 bits."""
    path.parent.mkdir(parents=True, exist_ok=True)
    state = {name: value.half() if value.ndim == 4 else value for name, value in network.state_dict().items()}
    partial = path.with_suffix(".part")
    torch.save(state, partial)
    partial.replace(path)


class _Clock:
    """Knows how much of the training is done, prints the parts of the loss, and when a checkpoint is due."""

    def __init__(self, options: TrainingOptions, checkpoint: Path, every: int = 100) -> None:
        self.options, self.every, self.path = options, every, checkpoint.with_suffix(".log")
        self.step, self.done, self.counted, self.sums = 0, 0.0, 0, torch.zeros(1)
        self.started = self.last = time.monotonic()
        self.end = self.started + 60 * options.minutes
        self.due = sorted(options.marks)

    def tick(self, parts: dict[str, Tensor], scenes: int) -> list[float]:
        """Count a step; return the marks that were passed."""
        values = torch.stack(list(parts.values()))
        self.sums, self.step, self.counted = self.sums.to(values.device) + values, self.step + 1, self.counted + 1
        if values.device.type != "cpu" and self.step % 10 == 3:
            torch.cuda.synchronize()  # or steps would be begun that nobody waits for
        now = time.monotonic()
        if self.step == 3:
            self.started = now  # the first steps take long: a device chooses its algorithms
        steps = self.options.steps
        self.done = self.step / steps if steps else (now - self.started) / (self.end - self.started)
        if self.step % self.every == 0 or self.done >= 1:
            self._print(list(parts), scenes, now)
        passed = [mark for mark in self.due if self.done >= mark]
        self.due = self.due[len(passed) :]
        return passed

    def _print(self, names: list[str], scenes: int, now: float) -> None:
        means = zip(names, (self.sums / self.counted).tolist(), strict=True)
        text = "  ".join(f"{name} {value:.3f}" for name, value in means)
        pace = (now - self.last) / self.counted
        line = f"step {self.step}  {self.done:.0%}  {pace:.3f} s/step  {scenes} scenes  {text}"
        print(line, flush=True)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        with self.path.open("a") as out:
            out.write(line + "\n")
        self.sums, self.counted, self.last = torch.zeros(1), 0, now
