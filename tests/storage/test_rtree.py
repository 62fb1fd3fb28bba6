import sqlite3
from contextlib import closing
from pathlib import Path

import numpy as np
import pyogrio
import pytest

from roadgeo.storage.geopackage import Layer, write_layers
from roadgeo.storage.rtree import pack_rtree


def boxes(n: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    low = rng.uniform([300_000, 4_680_000], [340_000, 4_700_000], (n, 2))
    high = low + rng.exponential(100, (n, 2)) * (rng.random((n, 1)) < 0.7)
    return np.column_stack([low[:, 0], high[:, 0], low[:, 1], high[:, 1]])


def in_sqlite(bounds: np.ndarray, page_size: int = 4096) -> sqlite3.Connection:
    """SQLite's own R-tree over a packed one."""
    database = sqlite3.connect(":memory:")
    database.execute(f"PRAGMA page_size = {page_size}")
    database.execute("CREATE VIRTUAL TABLE t USING rtree(id, a, b, c, d)")
    (size,) = database.execute("SELECT length(data) FROM t_node WHERE nodeno = 1").fetchone()
    tree = pack_rtree(bounds, size)
    database.executemany("REPLACE INTO t_node VALUES (?, ?)", enumerate((row.tobytes() for row in tree.nodes), 1))
    database.executemany("INSERT INTO t_parent VALUES (?, ?)", list(enumerate(tree.parents.tolist(), 1))[1:])
    database.executemany("INSERT INTO t_rowid VALUES (?, ?)", enumerate(tree.leaves.tolist(), 1))
    return database


@pytest.mark.parametrize("n", [1, 2, 50, 51, 52, 101, 102, 103, 51 * 51, 51 * 51 + 1, 9000])
@pytest.mark.parametrize("page_size", [1024, 4096])
def test_sqlite_finds_nothing_wrong_and_everything_inside(n: int, page_size: int) -> None:
    bounds = boxes(n)
    with closing(in_sqlite(bounds, page_size)) as database:
        assert database.execute("SELECT rtreecheck('t')").fetchone() == ("ok",)
        for x0, x1, y0, y1 in np.add(boxes(20, seed=1), [-500, 500, -500, 500]):
            found = database.execute(
                "SELECT id FROM t WHERE b >= ? AND a <= ? AND d >= ? AND c <= ?", (x0, x1, y0, y1)
            ).fetchall()
            a, b, c, d = bounds.T
            expected = set((np.flatnonzero((b >= x0) & (a <= x1) & (d >= y0) & (c <= y1)) + 1).tolist())
            slack = set((np.flatnonzero((b >= x0 - 1) & (a <= x1 + 1) & (d >= y0 - 1) & (c <= y1 + 1)) + 1).tolist())
            assert expected <= {i for (i,) in found} <= slack  # coordinates are stored in float32


def test_boxes_can_be_added_moved_and_removed_afterwards() -> None:
    bounds = boxes(3000)
    with closing(in_sqlite(bounds)) as database:
        database.executemany("DELETE FROM t WHERE id = ?", [(i,) for i in range(1, 2900)])
        database.executemany(
            "INSERT OR REPLACE INTO t VALUES (?, ?, ?, ?, ?)", [(i, 0, 1, 0, 1) for i in range(2990, 4000)]
        )
        assert database.execute("SELECT rtreecheck('t')").fetchone() == ("ok",)
        assert database.execute("SELECT count(*) FROM t").fetchone() == (90 + 1010,)
        assert database.execute("SELECT count(*) FROM t WHERE b <= 1").fetchone() == (1010,)


def test_equal_boxes_and_points() -> None:
    with closing(in_sqlite(np.ones((500, 4)))) as database:
        assert database.execute("SELECT rtreecheck('t')").fetchone() == ("ok",)
        assert database.execute("SELECT count(*) FROM t WHERE a = 1").fetchone() == (500,)


def test_neighbours_share_leaves() -> None:
    """The tree is a good one: its leaves are small."""
    low = np.random.default_rng(0).uniform(0, 1000, (10_000, 2))
    bounds = np.repeat(low, 2, axis=1)
    leaves = pack_rtree(bounds, 1228).leaves
    widths = [np.ptp(low[leaves == leaf], axis=0).max() for leaf in np.unique(leaves)[:20]]
    assert np.median(widths) < 3 * 1000 / np.sqrt(10_000 / 51)


def test_gdal_uses_it(tmp_path: Path) -> None:
    xy = np.random.default_rng(0).uniform(0, 1000, (5000, 2))
    write_layers(tmp_path / "a.gpkg", [Layer("points", "POINT", xy, {"n": np.arange(5000)}, "EPSG:32619")])
    _, _, _, (n,) = pyogrio.raw.read(tmp_path / "a.gpkg", layer="points", bbox=(100, 200, 150, 300))
    inside = (xy >= (100, 200)).all(axis=1) & (xy <= (150, 300)).all(axis=1)
    assert sorted(n) == np.flatnonzero(inside).tolist()
