"""Made-up streets and masks of them, drawn by nothing that is tested: numpy, shapely and OpenCV alone."""

from collections.abc import Sequence

import cv2
import numpy as np
import shapely

__all__ = ["CRS", "ORIGIN", "camera", "draw", "lattice", "mapped", "roads_of", "town", "view"]

CRS = "EPSG:32619"
#: Where the corner of a made-up map lies, metres.
ORIGIN = np.array([330_000.0, 4_690_000.0])


def town(seed: int, side: float = 3600.0, spacing: float = 120.0) -> list[np.ndarray]:
    """Streets (K, 2), metres: a lattice whose crossings are pushed about, a quarter of its streets left out."""
    rng = np.random.default_rng(seed)
    n = int(side / spacing)
    column, row = np.meshgrid(np.arange(n), np.arange(n))
    xy = spacing * np.stack([column, row], axis=-1) + rng.normal(0.0, 0.22 * spacing, (n, n, 2))
    pairs = [(xy[r, c], xy[r, c + 1]) for r in range(n) for c in range(n - 1)]
    pairs += [(xy[r, c], xy[r + 1, c]) for r in range(n - 1) for c in range(n)]
    return [np.array([a, (a + b) / 2 + rng.normal(0.0, 0.05 * spacing, 2), b]) for a, b in pairs if rng.random() < 0.75]


def lattice(seed: int, kept: float, blocks: tuple[int, int] = (30, 35), block: tuple[float, float] = (110.0, 90.0)):
    """Streets of equal blocks, metres; a share of `1 - kept` of the stretches between two crossings is missing."""
    rng = np.random.default_rng(seed)
    corners = [(c, r) for c in range(blocks[0]) for r in range(blocks[1])]
    stretches = [((c, r), (c + dc, r + dr)) for c, r in corners for dc, dr in ((1, 0), (0, 1))]
    return [np.array(ends) * block for ends in stretches if rng.random() < kept]


def roads_of(streets: list[np.ndarray]):
    """Streets as a GeoSeries that a reference is built from."""
    import geopandas as gpd

    return gpd.GeoSeries([shapely.LineString(street + ORIGIN) for street in streets], crs=CRS)


def camera(
    center: tuple[float, float],
    size: tuple[int, int] = (1000, 1000),
    gsd_m: float = 1.0,
    tilt_deg: float = 0.0,
    azimuth_deg: float = 0.0,
    heading_deg: float = 0.0,
    focal_px: float = 1000.0,
) -> np.ndarray:
    """Homography from the query plane (pixels, y up) to metres, of a pinhole whose axis meets the ground at `center`.

    The axis is tilted from the vertical towards `azimuth_deg`, clockwise from north; before tilting, the image's up
    points to `heading_deg`. `gsd_m` is measured across the axis at the frame's middle.
    """
    heading, azimuth, tilt = np.radians([heading_deg, azimuth_deg, tilt_deg])

    def turn(clockwise: float) -> np.ndarray:
        c, s = np.cos(clockwise), np.sin(clockwise)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])

    lean = np.array([[1, 0, 0], [0, np.cos(tilt), np.sin(tilt)], [0, -np.sin(tilt), np.cos(tilt)]])
    # Rays of the camera over the ground, z up: (x, y, -f) for a camera that looks straight down with up to the north.
    rays = turn(azimuth) @ lean.T @ turn(heading - azimuth)
    rays = rays @ np.array([[1, 0, -size[0] / 2], [0, 1, size[1] / 2], [0, 0, -focal_px]])
    distance = gsd_m * focal_px
    axis = rays @ (size[0] / 2, -size[1] / 2, 1) / focal_px
    eye = -distance * axis
    matrix = np.array([-eye[2] * rays[0] + eye[0] * rays[2], -eye[2] * rays[1] + eye[1] * rays[2], rays[2]])
    matrix = np.array([[1, 0, center[0]], [0, 1, center[1]], [0, 0, 1]]) @ matrix
    return matrix / (matrix[2] @ (size[0] / 2, -size[1] / 2, 1))


def view(
    center: tuple[float, float],
    size: tuple[int, int] = (1000, 1000),
    gsd_m: float = 1.0,
    heading_deg: float = 0.0,
    tilt_deg: float = 0.0,
) -> np.ndarray:
    """Return the homography from pixels (column, row; corners) to metres of a pinhole, tilted towards the image's up.

    The focal length is the frame's longer side.
    """
    flip = np.diag([1.0, -1.0, 1.0])
    return camera(center, size, gsd_m, tilt_deg, heading_deg, heading_deg, float(max(size))) @ flip


def mapped(matrix: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Points (N, 2) under a homography."""
    found = np.column_stack([xy, np.ones(len(xy))]) @ matrix.T
    return found[:, :2] / found[:, 2:]


def joined(lines: Sequence[np.ndarray]) -> np.ndarray:
    """LineString of each line's vertices (V, 2)."""
    return shapely.linestrings(np.concatenate(lines), indices=np.repeat(np.arange(len(lines)), [*map(len, lines)]))


def vertices(lines: Sequence[shapely.LineString], most_m: float) -> list[np.ndarray]:
    """Vertices (V, 2) of each line, once none of its segments is longer; all at once, which is far quicker."""
    xy, line = shapely.get_coordinates(shapely.segmentize(lines, most_m), return_index=True)
    return np.split(xy, np.flatnonzero(np.diff(line)) + 1)


def draw(
    streets: list[np.ndarray],
    matrix: np.ndarray,
    size: tuple[int, int] = (1000, 1000),
    width_m: float = 9.0,
    gsd_m: float = 1.0,
    seed: int = 0,
    missing: float = 0.0,
    false: float = 0.0,
) -> np.ndarray:
    """Draw the mask ((H, W) uint8) of what a camera sees.

    Parameters
    ----------
    missing, false : float
        Share of the streets that are not drawn, and number of false strokes as a share of those seen.
    """
    rng = np.random.default_rng(seed)
    back = np.linalg.inv(matrix)
    mask = np.zeros(size[::-1], np.uint8)
    thick = max(3, round(width_m / gsd_m))
    seen = 0
    lines = vertices(joined(streets), 10.0)
    xy = np.concatenate(lines)
    starts = np.cumsum([0, *map(len, lines[:-1])])
    pixels = mapped(back, xy)
    ahead = xy @ back[2, :2] + back[2, 2] > 0
    near = ahead & (pixels >= -500).all(axis=1) & (pixels <= np.array(size) + 500).all(axis=1)
    for n in np.flatnonzero(np.logical_and.reduceat(near, starts)):
        seen += 1
        if rng.random() >= missing:
            _stroke(mask, pixels[starts[n] : starts[n] + len(lines[n])], thick)
    for _ in range(int(false * seen)):
        middle, angle = rng.uniform((0, 0), size), rng.uniform(0, np.pi)
        reach = 60.0 / gsd_m * np.array([np.cos(angle), np.sin(angle)])
        _stroke(mask, np.array([middle - reach, middle + reach]), thick)
    return mask


def _stroke(mask: np.ndarray, pixels: np.ndarray, thick: int) -> None:
    points = np.round((pixels - 0.5) * 16).astype(np.int32).reshape(-1, 1, 2)
    cv2.polylines(mask, [points], False, 255, thick, cv2.LINE_8, 4)
