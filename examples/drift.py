"""How far frames without roads drift by their motion alone: the filter, and the least that any method could reach.

    OMP_NUM_THREADS=1 python examples/drift.py --flights 100 --seed 1000

Simulated flights of 19 frames over ground without roads: the corners of the first frame are known to 0.3 m, each motion
to 0.7 pixels. Shown is the distance of the last frame's middle from the truth, root mean square. The filter's distance
is measured. The least is computed: all frames adjusted at once, linearised at the truth (Cramer-Rao bound), for cameras
that are known more or less, and with other knowledge beside the motions.
"""

import argparse
import math

import numpy as np
from simulated_flights import FlightOptions, _draw_views, _motion

from roadgeo._arrays import FloatArray
from roadgeo.flights.pose import FramePose, predict, start
from roadgeo.geometry.frame import Frame
from roadgeo.geometry.pinhole import View
from roadgeo.geometry.pose import _place, _starts

OPTIONS, START_M = FlightOptions(n_frames=(19, 19), gsd_m=(0.5, 0.5)), 0.3
#: Numbers of a frame: where its axis meets the ground (2), log metres per pixel, heading, tilt (2), log focal length,
#: and both skews, as of ground that is no plane.
N, HEIGHT, HEADING, TILT, FOCAL, SKEWS = 9, slice(2, 3), slice(3, 4), slice(4, 6), slice(6, 7), slice(7, 9)
EXACT = 1e-7
#: Standard deviations of the first focal length, its change between frames, and of the other parameters.
CASES = {
    "the filter's model: focal length unknown, skews .005": {"focal": 0.45, "refocusing": 0.002, "skews": 0.005},
    "the same, skews .002": {"focal": 0.45, "refocusing": 0.002, "skews": 0.002},
    "a pinhole of unknown focal length": {"focal": 0.45},
    "a pinhole of known focal length": {},
    "... its tilt known to 0.2 degrees": {"tilt": math.radians(0.2)},
    "... its tilt known": {"tilt": EXACT},
    "... its height known to 0.5 %": {"height": 0.005},
    "... its height and tilt known": {"tilt": EXACT, "height": EXACT},
    "... its height, tilt and heading known": {"tilt": EXACT, "height": EXACT, "heading": EXACT},
}


class Anywhere:
    """Ground without an end."""

    bounds = (np.zeros(2), np.ones(2))

    @staticmethod
    def covers(_: FloatArray) -> bool:
        return True


def fly(number: int) -> tuple[tuple[View, ...], FramePose]:
    """Follow a flight by its motion alone; return its views and the last pose."""
    rng = np.random.default_rng(number)
    views = _draw_views(Anywhere(), OPTIONS, rng)
    corners = views[0].footprint + rng.normal(0.0, START_M, (4, 2))
    pose = start(corners, Frame(*OPTIONS.size_px), START_M**2 * np.eye(8))
    for motion in _motion(views, OPTIONS.motion_px, rng)[1:]:
        pose = predict(pose, motion, math.sqrt(2.0) * OPTIONS.motion_px)
    return views, pose


def least(views: tuple[View, ...], known: dict[str, float]) -> float:
    """Return the variance of the last middle's place, both axes together, by all frames at once."""
    frame, log_focal = Frame(*OPTIONS.size_px), math.log(views[0].focal_px)
    focals = np.array([views[0].focal_px])
    truth = np.array([np.append(_starts(v.homography.matrix, frame, focals, log_focal)[0], (0.0, 0.0)) for v in views])
    step = np.tile([1e-3, 1e-3] + [1e-6] * (N - 2), len(views))
    sigmas = {"focal": EXACT, "refocusing": EXACT, "skews": EXACT} | known

    def residuals(x: FloatArray) -> FloatArray:
        frames = x.reshape(-1, N)
        off, ground = frames - truth, homographies(frames, frame, log_focal)
        corners = apply(ground, frame.corners)
        moved = apply(np.linalg.inv(ground[:-1]), corners[1:])
        parts = [
            corners[0] / START_M,
            moved / OPTIONS.motion_px,
            off[0, FOCAL] / sigmas["focal"],
            np.diff(off[:, FOCAL], axis=0) / sigmas["refocusing"],
            off[:, SKEWS] / sigmas["skews"],
        ]
        others = {"height": HEIGHT, "heading": HEADING, "tilt": TILT}
        parts += [off[:, at] / sigmas[name] for name, at in others.items() if name in sigmas]
        return np.concatenate([part.ravel() for part in parts])

    x = truth.ravel()
    jacobian = np.stack([residuals(x + dx) - residuals(x - dx) for dx in np.diag(step)], axis=1) / 2.0
    root = np.linalg.inv(np.linalg.qr(jacobian, mode="r")) * step[:, None]
    return float((root[-N : -N + 2] ** 2).sum())


def homographies(frames: FloatArray, frame: Frame, log_focal: float) -> FloatArray:
    """Return pixel to ground (K, 3, 3) of frames (K, N)."""
    positions, rotations = _place(frames[:, :7], log_focal)
    (x, y), nothing, item = frame.center, np.zeros(len(frames)), np.ones(len(frames))
    skew, longer = 0.5 * frames[:, SKEWS].T
    lens = np.moveaxis(
        np.array([
            [item + longer, skew, nothing],
            [-skew, longer - item, nothing],
            [nothing, nothing, -np.exp(frames[:, 6])],
        ]),
        2, 0,
    )  # fmt: skip
    rays = rotations @ lens @ np.array([[1.0, 0.0, -x], [0.0, 1.0, -y], [0.0, 0.0, 1.0]])
    return np.concatenate((positions[:, :2, None] * rays[:, 2:] - positions[:, 2:, None] * rays[:, :2], rays[:, 2:]), 1)


def apply(matrices: FloatArray, points: FloatArray) -> FloatArray:
    """Return points, (M, 2) or (K, M, 2), taken by homographies (K, 3, 3)."""
    seen = np.insert(points, 2, 1.0, axis=-1) @ np.swapaxes(matrices, 1, 2)
    return seen[..., :2] / seen[..., 2:]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--seed", type=int, default=1000)
    given = parser.parse_args()
    flights = [fly(given.seed + k) for k in range(given.flights)]
    error = np.array([np.hypot(*(pose.center - views[-1].homography(pose.frame.center))) for views, pose in flights])
    claimed = np.array([pose.sigma_m for _, pose in flights])
    print(f"{'the filter':54} {np.sqrt(np.mean(error**2)):5.1f} m")
    print(f"{'  it claims':54} {np.sqrt(np.mean(claimed**2)):5.1f} m")
    print(f"{'  error / claimed':54} {np.sqrt(np.mean((error / claimed) ** 2)):5.2f}")
    for name, known in CASES.items():
        print(f"{name:54} {math.sqrt(np.mean([least(views, known) for views, _ in flights])):5.1f} m", flush=True)


if __name__ == "__main__":
    main()
