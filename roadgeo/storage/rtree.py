"""An R-tree in the form in which SQLite's rtree module stores it, packed at once.

Inserting boxes one by one takes SQLite some 8 microseconds each: most of the time of writing a large GeoPackage.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from roadgeo._arrays import AnyArray, Float32Array, FloatArray, IntArray

__all__ = ["PackedTree", "pack_rtree"]

_CELL = np.dtype([("id", ">i8"), ("box", ">f4", 4)])


class PackedTree(NamedTuple):
    """Rows of the three tables behind a virtual table. Dimensions: N boxes, M nodes.

    Attributes
    ----------
    nodes : (M,) structured
        Node m + 1 as it is stored; node 1 is the root.
    parents : (M,) int64
        Number of each node's parent, 0 for the root.
    leaves : (N,) int64
        Number of the node that holds each box.
    """

    nodes: AnyArray
    parents: IntArray
    leaves: IntArray


def pack_rtree(bounds: FloatArray, node_size: int) -> PackedTree:
    """Pack boxes into an R-tree by tiles of equal numbers (Leutenegger et al. 1997, sort-tile-recursive).

    Parameters
    ----------
    bounds : (N, 4) float64
        Min x, max x, min y, max y of boxes 1 to N; N > 0.
    node_size : int
        Bytes of a node, as SQLite chose it.

    Returns
    -------
    PackedTree
    """
    capacity = (node_size - 4) // _CELL.itemsize
    node_type = np.dtype(
        {
            "names": ["depth", "count", "cells"],
            "formats": [">u2", ">u2", (_CELL, capacity)],
            "offsets": [0, 2, 4],
            "itemsize": node_size,
        }
    )
    order = _tile(bounds, capacity)
    ids, boxes = order + 1, _outward(bounds)[order]
    sizes = [-(-len(ids) // capacity)]
    while sizes[-1] > 1:
        sizes.append(-(-sizes[-1] // capacity))
    first = np.cumsum([1, *sizes[:0:-1]])[::-1]  # the root is node 1, its children come next, the leaves last
    nodes = np.zeros(sum(sizes), node_type)
    parents = np.zeros(len(nodes), np.int64)
    for level, size in enumerate(sizes):
        group = np.arange(len(ids)) // capacity
        node = first[level] - 1 + group
        place = np.arange(len(ids)) % capacity
        nodes["cells"]["id"][node, place] = ids
        nodes["cells"]["box"][node, place] = boxes
        nodes["count"][first[level] - 1 : first[level] - 1 + size] = np.bincount(group)
        if level:
            parents[ids - 1] = node + 1
        starts = np.arange(0, len(ids), capacity)
        boxes = np.stack(
            [(np.maximum if i % 2 else np.minimum).reduceat(boxes[:, i], starts) for i in range(4)], axis=1
        )
        ids = first[level] + np.arange(size)
    nodes["depth"][0] = len(sizes) - 1
    leaves = np.empty(len(bounds), np.int64)
    leaves[order] = first[0] + np.arange(len(bounds)) // capacity
    return PackedTree(nodes, parents, leaves)


def _tile(bounds: FloatArray, capacity: int) -> IntArray:
    """Order boxes so that each run of `capacity` lies close together: columns of tiles, and rows within a column."""
    n = len(bounds)
    x, y = bounds[:, 0] + bounds[:, 1], bounds[:, 2] + bounds[:, 3]
    n_columns = max(1, round(np.sqrt(n / capacity)))
    column = np.empty(n, np.int64)
    column[np.argsort(x, kind="stable")] = np.arange(n) * n_columns // n
    return np.lexsort((y, column))


def _outward(bounds: FloatArray) -> Float32Array:
    """Round boxes to float32 so that they hold what they held."""
    boxes = bounds.astype(np.float32)
    low, high = boxes[:, ::2], boxes[:, 1::2]
    low[low > bounds[:, ::2]] = np.nextafter(low, np.float32(-np.inf))[low > bounds[:, ::2]]
    high[high < bounds[:, 1::2]] = np.nextafter(high, np.float32(np.inf))[high < bounds[:, 1::2]]
    return boxes
