"""Draw docs/how-it-works.png: the mask of a drone on its way to a place in Porto. Needs matplotlib.

    python docs/draw_how_it_works.py

Everything in it is computed by roadgeo from the data of `roadgeo demo`.
"""

from pathlib import Path

import cv2
import matplotlib as mpl
import numpy as np

import roadgeo
from roadgeo.evaluation.demo import ATTRIBUTION, ROADS, demo_masks
from roadgeo.kernels.structs import Hits, TripleLimits, TripleQuery
from roadgeo.kernels.triple_codes import UNITS, find_sides
from roadgeo.kernels.triples import look_up_each
from roadgeo.matching.index import ReferenceIndex, build_index
from roadgeo.matching.scene import MIN_COS, Scene, trace_query
from roadgeo.matching.triples import TripleOptions, propose
from roadgeo.reference.reference import Reference
from roadgeo.roads.network import build_network
from roadgeo.sources.masks import read_mask
from roadgeo.sources.roads import read_roads

mpl.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

INK, FAINT, PAPER, MAP = "#262a30", "#6e7278", "#f3f1ec", "#babcbe"
ROAD, CROSSING, FRAME, AGREES = "#e4572e", "#1b263b", "#1f6fb4", "#008080"
COLORS = ("#d3128b", "#2f55d4", "#e07b00")  # the three intersections of the triple
CORNERS = np.array([[0.0, 0.0], [1.0, 0.0], [0.5, np.sqrt(0.75)]])
STAGES = (3, 12, 40)  # matches after which a grown homography is drawn


def main() -> None:
    """Draw the six steps."""
    path = demo_masks()[1].path
    mask = read_mask(path)
    roads = read_roads(ROADS)
    network = build_network(roads.lines, roads.plane, {"name": "porto"})
    reference = Reference(build_index(network), network)
    index = reference.index
    location = roadgeo.locate(mask, reference)
    scene, graph = trace_query(mask)
    to_map = plane_homography(location.homography, index)
    triple, hits, true = find_triple(scene, index, to_map)
    tangents = index.tangents * (np.pi / 32767)
    tangents = np.where(index.tangents >= 0, tangents, np.nan).astype(np.float32)
    query = scene.intersections
    seen_roads = [np.asarray(line) for line in graph.polylines()]

    figure, axes = plt.subplots(2, 3, figsize=(15, 8.6), layout="constrained")
    figure.get_layout_engine().set(w_pad=0.12, h_pad=0.1)
    titles = (
        "1  The mask: where there is road",
        "2  Its roads and intersections",
        "3  Three intersections, made equilateral",
        f"4  The code looked up on the map: {len(hits)} fit",
        "5  The right one grows outwards",
        "6  All roads are compared: located",
    )
    for ax, title in zip(axes.flat, titles, strict=True):
        ax.set_title(title, loc="left", fontsize=14.5, fontweight="bold", color=INK)
        ax.set_xticks([])
        ax.set_yticks([])
        for spine in ax.spines.values():
            spine.set_color("#d0d0cc")
    width, height = scene.size
    for ax in axes.flat[:3]:
        ax.set(xlim=(0, width), ylim=(-height, 0), aspect="equal")
    axes[0, 0].imshow(255 - mask.roads.astype(np.uint8) * 255, cmap="gray", extent=(0, width, -height, 0), vmin=-60)

    seen = axes[0, 1]
    draw_lines(seen, seen_roads, ROAD, 1.4)
    for xy, directions in zip(query.xy, query.tangents, strict=True):
        draw_sticks(seen, xy, directions, 21, CROSSING, 1.3)
    seen.plot(*query.xy.T, "o", color=CROSSING, ms=3.2)
    middle = query.xy[triple].mean(axis=0)
    draw_triangle(seen, query.xy[triple], 6)

    draw_codes(axes[0, 2], seen_roads, query.xy, query.tangents, triple, middle, index, tangents, hits[true])
    draw_hits(axes[1, 0], index, hits, true)
    draw_growth(axes[1, 1], scene, index, triple, hits[true], location.place.matches, to_map)
    draw_location(axes[1, 2], scene, index, seen_roads, location, to_map)
    figure.text(0.995, 0.002, ATTRIBUTION, ha="right", va="bottom", fontsize=9, color=FAINT)
    write(figure, Path(__file__).parent / "how-it-works.png")


# --- what is drawn ----------------------------------------------------------------------------------------------------


def plane_homography(homography: np.ndarray, index: ReferenceIndex) -> np.ndarray:
    """From the query plane (y up) to the index's plane, metres from its origin."""
    x, y = index.plane.origin
    return np.array([[1, 0, -x], [0, 1, -y], [0, 0, 1]]) @ homography @ np.diag([1.0, -1.0, 1.0])


def apply(matrix: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Map (N, 2) points by a homography."""
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return mapped[:, :2] / mapped[:, 2:]


def find_triple(scene: Scene, index: ReferenceIndex, to_map: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return a triple of the query, all triples of the map that fit it (M, 3), and which of them is the true one.

    The triple is one that the search itself looks up early, wide and not at the frame's edge, so that it can be seen.
    """
    options = TripleOptions()
    xy, tangents = scene.intersections.xy, scene.intersections.tangents
    neighbours = np.ascontiguousarray(scene.neighbours[:, : options.n_neighbours])
    sides = np.empty(tangents.shape, np.int8)
    find_sides(tangents, scene.branches, sides)
    seen = TripleQuery(xy, scene.branches, tangents, sides, neighbours)
    tolerance = round(options.angle_tolerance_deg * UNITS / 180)
    limits = TripleLimits(1, tolerance, MIN_COS, (0.1, 10.0), 0.33)
    good = []
    for (proposals,) in propose(scene, [index], (0.1, 10.0), 0.33, options):
        a = proposals.anchor
        for s in range(8):
            for t in range(s + 1, 8):
                b, c = neighbours[a, s], neighbours[a, t]
                found = Hits(np.empty((12_000, 5), np.int64), np.empty((12_000, 4)))
                n, _ = look_up_each(seen, a, np.array([[s, t]]), 10**9, index.triple_map, limits, found)
                ids = found.ids
                hits = ids[:n][:, [0, 2, 4]]
                triple = np.array([a, b, c])
                edges = xy[triple] - xy[np.roll(triple, 1)]
                turn = edges[1][0] * edges[2][1] - edges[1][1] * edges[2][0]
                triple = triple if turn > 0 else triple[[0, 2, 1]]
                apart = np.hypot(*(index.xy[hits] - apply(to_map, xy[triple])).transpose(2, 0, 1)).max(axis=1)
                two = (~np.isnan(tangents[triple])).sum(axis=1) == 2
                lengths = np.hypot(*edges.T)
                inside = (np.abs(xy[triple].mean(axis=0) - scene.center) < np.array(scene.size) * 0.33).all()
                if 4 <= n <= 12 and apart.min(initial=99) < 8 and two.all() and inside and lengths.min() > 60:
                    shape = abs(turn) / lengths.max() ** 2
                    good.append((shape * lengths.min(), triple, hits, int(apart.argmin())))
    _, triple, hits, true = max(good, key=lambda entry: entry[0])
    return triple, hits, true


# --- drawing ----------------------------------------------------------------------------------------------------------


def draw_lines(ax: Axes, lines: list[np.ndarray], color: str, width: float, **more: object) -> None:
    """Draw many lines as one thing."""
    ax.add_collection(LineCollection(lines, colors=color, linewidths=width, capstyle="round", **more))


def draw_sticks(ax: Axes, xy: np.ndarray, directions: np.ndarray, half: float, color: str, width: float) -> None:
    """Draw tangents as short lines through an intersection."""
    for angle in directions[~np.isnan(directions)]:
        step = half * np.array([np.cos(angle), np.sin(angle)])
        ax.plot(*np.array([xy - step, xy + step]).T, color=color, lw=width, solid_capstyle="round")


def draw_triangle(ax: Axes, xy: np.ndarray, size: float) -> None:
    """Draw a triple in its three colours."""
    ax.fill(*xy.T, color="#ffd94a", alpha=0.55, lw=0, zorder=2)
    ax.plot(*np.vstack([xy, xy[:1]]).T, color=INK, lw=1.4, zorder=3)
    for point, color in zip(xy, COLORS, strict=True):
        ax.plot(*point, "o", color=color, ms=size, mec="white", mew=1.2, zorder=5)


def draw_codes(
    ax: Axes, roads: list, xy: np.ndarray, directions: np.ndarray, triple: np.ndarray, middle: np.ndarray,
    index: ReferenceIndex, ref_directions: np.ndarray, hit: np.ndarray,
) -> None:  # fmt: skip
    """Draw the triple in the mask and on the map, each with its equilateral triangle and its code."""
    ax.set(xlim=(0, 4), ylim=(0, 3), aspect="equal")
    ax.set_axis_off()
    ref_roads = list(index.segments.reshape(-1, 2, 2).astype(float))
    rows = (
        ("in the mask", roads, xy, directions, triple, ROAD, middle, 150.0),
        ("on the map", ref_roads, index.xy, ref_directions, hit, "#8d9094", index.xy[hit].mean(axis=0), 175.0),
    )
    for row, (name, lines, points, angles, ids, color, center, reach) in enumerate(rows):
        y0 = 0.515 if row == 0 else 0.0
        near = ax.inset_axes((0.0, y0, 0.45, 0.485))
        near.set(xlim=center[0] + np.array([-1, 1]) * reach, ylim=center[1] + np.array([-1, 1]) * reach, aspect="equal")
        near.set(xticks=[], yticks=[], facecolor="white" if row == 0 else PAPER)
        draw_lines(near, lines, color, 2.2)
        for i, shade in zip(ids, COLORS, strict=True):
            draw_sticks(near, points[i], angles[i], 0.3 * reach, shade, 2.6)
        draw_triangle(near, points[ids], 9)
        near.text(0.03, 0.96, name, transform=near.transAxes, va="top", fontsize=12, color=INK,
                  bbox={"fc": "white", "ec": "none", "alpha": 0.85, "pad": 2})  # fmt: skip
        even = ax.inset_axes((0.5, y0, 0.5, 0.485))
        even.set(xlim=(-0.85, 1.85), ylim=(-0.65, 1.32), aspect="equal")
        even.set_axis_off()
        draw_equilateral(even, points, angles, ids)
        ax.annotate("", (0.545, y0 + 0.26), (0.46, y0 + 0.26), xycoords="axes fraction",
                    arrowprops={"arrowstyle": "-|>", "color": INK, "lw": 1.8})  # fmt: skip


def draw_equilateral(ax: Axes, xy: np.ndarray, directions: np.ndarray, ids: np.ndarray) -> None:
    """Draw the triangle as the affine map makes it, with its tangents."""
    affine = to_equilateral(xy[ids])
    for corner, i, color in zip(CORNERS, ids, COLORS, strict=True):
        for angle in directions[i][~np.isnan(directions[i])]:
            step = affine @ (np.cos(angle), np.sin(angle))
            step *= 0.34 / np.hypot(*step)
            ax.plot(*np.array([corner - step, corner + step]).T, color=color, lw=2.8, solid_capstyle="round")
    draw_triangle(ax, CORNERS, 9)
    places = ((-0.2, -0.5), (1.2, -0.5), (1.25, 0.95))
    for place, pair, color in zip(places, code(xy, directions, ids), COLORS, strict=True):
        ax.text(
            *place, f"{pair[0]}°, {pair[1]}°", ha="center", va="center", fontsize=13, fontweight="bold", color=color
        )


def code(xy: np.ndarray, directions: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """(3, 2) degrees of two tangents in the equilateral frame, from the axis towards its middle, as fine as stored."""
    affine = to_equilateral(xy[ids])
    pairs = []
    for corner, i in zip(CORNERS, ids, strict=True):
        angles = directions[i][~np.isnan(directions[i])]
        x, y = affine @ (np.cos(angles), np.sin(angles))
        to_middle = np.arctan2(*(CORNERS.mean(axis=0) - corner)[::-1])
        units = np.floor((np.arctan2(y, x) - to_middle) % np.pi * (UNITS / np.pi))
        apart = np.abs(units[:, None] - units)
        openly = np.unravel_index(np.argmax(np.minimum(apart, UNITS - apart)), apart.shape)
        pairs.append(np.sort(units[list(openly)]))
    return np.rint(np.array(pairs) * (180 / UNITS)).astype(int)


def to_equilateral(triangle: np.ndarray) -> np.ndarray:
    """Linear part of the affine map that makes a triangle equilateral."""
    return CORNERS[1:].T @ np.linalg.inv(np.stack([triangle[1] - triangle[0], triangle[2] - triangle[0]], axis=1))


def draw_map(ax: Axes, index: ReferenceIndex, center: np.ndarray, reach: tuple[float, float], width: float) -> None:
    """Draw the roads of the reference around a point."""
    ax.set(xlim=center[0] + np.array([-1, 1]) * reach[0], ylim=center[1] + np.array([-1, 1]) * reach[1])
    ax.set(aspect="equal", facecolor=PAPER)
    draw_lines(ax, list(index.segments.reshape(-1, 2, 2).astype(float)), MAP, width)


def draw_hits(ax: Axes, index: ReferenceIndex, hits: np.ndarray, true: int) -> None:
    """Draw every triple of the map whose code fits."""
    low, high = np.percentile(index.xy, (0.5, 99.5), axis=0)
    half = (high - low).max() / 2
    draw_map(ax, index, (low + high) / 2, (half, 0.75 * half), 0.5)
    for k, hit in enumerate(hits):
        xy = index.xy[hit]
        ax.fill(*xy.T, color=AGREES if k == true else ROAD, lw=0, alpha=0.9, zorder=3)
        ring = plt.Circle(xy.mean(axis=0), 190, fill=False, ec=AGREES if k == true else ROAD, lw=2.6, zorder=4)
        ax.add_patch(ring)
    ax.annotate("this one is right:\nits neighbours fit too", index.xy[hits[true]].mean(axis=0) + np.array([60, -180]),
                (0.97, 0.05), textcoords="axes fraction", ha="right", va="bottom", fontsize=13, color=AGREES,
                fontweight="bold", arrowprops={"arrowstyle": "-", "color": AGREES, "lw": 1.6},
                bbox={"fc": "white", "ec": "none", "alpha": 0.9, "pad": 3}, zorder=6)  # fmt: skip


def draw_growth(
    ax: Axes, scene: Scene, index: ReferenceIndex, triple: np.ndarray, hit: np.ndarray, matches: object,
    to_map: np.ndarray,
) -> None:  # fmt: skip
    """Draw the frame as the first 3, 12, 40 and all matches place it."""
    center, reach = frame_view(scene, to_map)
    draw_map(ax, index, center, reach, 1.6)
    x, y = index.plane.origin
    first = scene.intersections.xy[triple], index.xy[hit]
    pairs = matches.query_xy, matches.reference_xy - (x, y)
    away = np.hypot(*(pairs[0] - scene.intersections.xy[triple].mean(axis=0)).T)
    order = np.argsort(away)
    shades = mpl.colormaps["viridis"](np.linspace(0.85, 0.05, len(STAGES) + 1))
    for stage, shade in zip((*STAGES, len(order)), shades, strict=True):
        matrix = fit(*(first if stage == 3 else (points[order[:stage]] for points in pairs)))
        outline = apply(matrix, np.vstack([scene.corners, scene.corners[:1]]))
        ax.plot(*outline.T, color=shade, lw=2.4, label=f"{stage} intersections", zorder=4)
    stage_of = np.searchsorted(STAGES, np.argsort(order), side="right")
    ax.scatter(*pairs[1].T, c=shades[stage_of], s=34, ec="white", lw=0.8, zorder=5)
    draw_triangle(ax, index.xy[hit], 6)
    ax.legend(loc="lower right", fontsize=12, framealpha=0.95, edgecolor="none", title="frame, as placed by")


def fit(query: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Three matches give an affine map, more a homography."""
    if len(query) == 3:
        return np.vstack([cv2.getAffineTransform(query.astype(np.float32), image.astype(np.float32)), [0, 0, 1]])
    shift = image.mean(axis=0)
    matrix, _ = cv2.findHomography(query, image - shift)
    return np.array([[1, 0, shift[0]], [0, 1, shift[1]], [0, 0, 1]]) @ matrix


def frame_view(scene: Scene, to_map: np.ndarray) -> tuple[np.ndarray, tuple[float, float]]:
    """Middle and half sides of a view that shows the frame and its surroundings."""
    corners = apply(to_map, scene.corners)
    low, high = corners.min(axis=0), corners.max(axis=0)
    half = max((high - low)[0] / 2, (high - low)[1] / 1.5) * 1.14
    return (low + high) / 2 + (0.1 * half, 0.0), (half, 0.75 * half)  # room for words on the right


def draw_location(
    ax: Axes, scene: Scene, index: ReferenceIndex, roads: list, location: object, to_map: np.ndarray
) -> None:
    """Draw footprint and roads on the map, and the numbers."""
    center, reach = frame_view(scene, to_map)
    draw_map(ax, index, center, reach, 3.4)
    outline = apply(to_map, np.vstack([scene.corners, scene.corners[:1]]))
    ax.fill(*outline.T, color="white", alpha=0.6, lw=0, zorder=1.5)
    draw_lines(ax, [apply(to_map, line) for line in roads], AGREES, 1.5, zorder=3)
    ax.plot(*outline.T, color=FRAME, lw=3, zorder=4)
    document = location.to_dict()
    text = (
        f"{document['n_matched']} of {document['n_intersections']} intersections match\n"
        f"lead over any other place $10^{{{document['log10_odds']:.1f}}}$\n"
        f"corners ± {max(document['corner_sigma_m']):.1f} m"
    )
    ax.text(0.985, 0.02, text, transform=ax.transAxes, fontsize=12, color=INK, ha="right", va="bottom", zorder=6,
            bbox={"fc": "white", "ec": "none", "alpha": 0.95, "pad": 4})  # fmt: skip


def write(figure: plt.Figure, path: Path) -> None:
    """Write the figure with 256 colours, which it does not need more of."""
    figure.canvas.draw()
    picture = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    from PIL import Image

    Image.fromarray(picture).quantize(256, dither=Image.Dither.NONE).save(path, optimize=True)


if __name__ == "__main__":
    main()
