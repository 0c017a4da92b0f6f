"""A bounding volume hierarchy with binned SAH splits, built level by level in numpy.

Section 5.1 of Overbeck, Ramamoorthi and Mark (2008) names a "binned SAH build"; the rules are
those of Wald, "On fast Construction of SAH-based Bounding Volume Hierarchies" (2007), all three
axes binned. Every step is exact or a fixed sequence of roundings: equal input, equal tree.
"""

from dataclasses import dataclass

import numpy as np

NUM_BINS = 16
# Leaves hold at most this many triangles; fewer where the SAH says so.
LEAF_SIZE = 8
# Price of one box test in triangle tests.
TRAVERSAL_COST = 1.0


@dataclass(frozen=True)
class Bvh:
    """A flattened tree, level by level, the root first; without triangles it has no nodes.

    Attributes
    ----------
    low, high : (n, 3) float32
        Boxes, exact.
    left : (n,) int32
        First child, the other is the next node; -1 for a leaf. `left` has the smaller centroids
        along `axis`.
    axis : (n,) int8
        Axis of the split; 0 for a leaf.
    first, count : (n,) int32
        The triangles of the subtree: order[first : first + count]. A leaf's are its own.
    depth : (n,) int32
        Edges up to the root.
    order : (m,) int32
        All triangles, those of a leaf side by side.
    """

    low: np.ndarray
    high: np.ndarray
    left: np.ndarray
    axis: np.ndarray
    first: np.ndarray
    count: np.ndarray
    depth: np.ndarray
    order: np.ndarray

    @property
    def num_nodes(self):
        """Number of nodes, leaves included."""
        return len(self.left)

    @property
    def num_levels(self):
        """Number of levels; 0 without nodes."""
        return int(self.depth.max(initial=-1)) + 1

    def statistics(self):
        """Return counts and the SAH cost as plain Python objects.

        Returns
        -------
        dict
            nodes, leaves, levels, triangles, largest_leaf, mean_leaf and sah_cost: the expected
            price of a random line through the root's box, in triangle tests.
        """
        leaf = self.left < 0
        area = half_area(self.low, self.high)
        share = area / area[:1] if area[:1].any() else np.ones(self.num_nodes)
        price = np.where(leaf, self.count, TRAVERSAL_COST)
        return {
            "nodes": self.num_nodes,
            "leaves": int(leaf.sum()),
            "levels": self.num_levels,
            "triangles": len(self.order),
            "largest_leaf": int(self.count[leaf].max(initial=0)),
            "mean_leaf": float(self.count[leaf].mean()) if leaf.any() else 0.0,
            "sah_cost": float((share * price).sum()),
        }


def half_area(low, high):
    """Return half the surface of boxes (n, 3) in float64; 0 for empty ones (low > high)."""
    x, y, z = np.maximum(high.astype(np.float64) - low, 0).T
    return x * y + y * z + z * x


def build_bvh(corners, num_bins=NUM_BINS, leaf_size=LEAF_SIZE):
    """Build the tree.

    Parameters
    ----------
    corners : (m, 3 corners, 3) float32
        Finite.
    num_bins : int
        At least 2.
    leaf_size : int
        At least 1.

    Returns
    -------
    Bvh

    Raises
    ------
    ValueError
        An option out of its range.
    """
    if num_bins < 2 or leaf_size < 1:
        raise ValueError(
            f"build_bvh: need num_bins >= 2, leaf_size >= 1, got {num_bins}, {leaf_size}"
        )
    builder = _Builder(corners, num_bins, leaf_size)
    count = np.array([len(corners)] if len(corners) else [], np.int64)
    first, levels, num_nodes = np.zeros_like(count), [], 0
    while len(first):
        num_nodes += len(first)
        low, high, axis, left_count = builder.split(first, count)
        inner = left_count > 0
        left = np.where(inner, num_nodes + 2 * (np.cumsum(inner) - 1), -1)
        depth = np.full(len(first), len(levels))
        levels.append((low, high, left, axis, first, count, depth))
        first, count, left_count = first[inner], count[inner], left_count[inner]
        first = np.stack([first, first + left_count], axis=1).reshape(-1)
        count = np.stack([left_count, count - left_count], axis=1).reshape(-1)
    if not levels:
        levels.append((np.zeros((0, 3)), np.zeros((0, 3)), *np.zeros((5, 0))))
    columns = (np.concatenate(column) for column in zip(*levels, strict=True))
    dtypes = (np.float32, np.float32, np.int32, np.int8, np.int32, np.int32, np.int32)
    arrays = (column.astype(dtype) for column, dtype in zip(columns, dtypes, strict=True))
    return Bvh(*arrays, builder.order.astype(np.int32))


def ranges(counts):
    """Return (row, place): row k counts[k] times, with places 0 to counts[k] - 1."""
    counts = np.asarray(counts)
    row = np.repeat(np.arange(len(counts)), counts)
    starts = np.cumsum(counts) - counts
    return row, np.arange(len(row)) - starts[row]


class _Builder:
    """The order of the triangles, and the splits of one level of nodes at a time."""

    def __init__(self, corners, num_bins, leaf_size):
        self.low, self.high = corners.min(axis=1), corners.max(axis=1)
        self.centre = self.low.astype(np.float64) + self.high  # twice the centre, exact enough
        self.order = np.arange(len(corners))
        self.num_bins, self.leaf_size = num_bins, leaf_size

    def split(self, first, count):
        """Sort the triangles of nodes into halves.

        Returns
        -------
        low, high : (k, 3) float32
        axis, left_count : (k,) int
            The left half is the first `left_count` triangles; 0 where the node is a leaf.
        """
        row, place = ranges(count)
        slots = first[row] + place
        triangle = self.order[slots]
        starts = np.cumsum(count) - count
        low = np.minimum.reduceat(self.low[triangle], starts)
        high = np.maximum.reduceat(self.high[triangle], starts)
        bins = self._bins(row, triangle, starts)
        axis, last_bin, cost = self._best(row, triangle, bins, len(count))
        area = half_area(low, high)
        cheaper = TRAVERSAL_COST * area + cost < count * area  # False where there is no split
        inner = (count > 1) & (cheaper | (count > self.leaf_size))
        # Centroids that share all their bins are halved in their order, so that it ends.
        chosen = bins[np.arange(len(row)), axis[row]] > last_bin[row]
        right = np.where(np.isfinite(cost)[row], chosen, place >= count[row] // 2)
        right &= inner[row]
        self.order[slots] = triangle[np.argsort(2 * row + right, kind="stable")]
        left_count = count - np.add.reduceat(right, starts, dtype=np.int64)
        return low, high, np.where(inner, axis, 0), np.where(inner, left_count, 0)

    def _bins(self, row, triangle, starts):
        """Return the bin of each triangle's centre along each axis, (k, 3)."""
        centre = self.centre[triangle]
        low = np.minimum.reduceat(centre, starts)
        extent = np.maximum.reduceat(centre, starts) - low
        scale = self.num_bins / np.where(extent > 0, extent, np.inf)
        return np.minimum((centre - low[row]) * scale[row], self.num_bins - 1).astype(np.int64)

    def _best(self, row, triangle, bins, num_nodes):
        """Return per node the axis, the last bin of the left half and its SAH cost (inf: none).

        The cost is area x triangles of both halves. Equal costs: smaller axis, then bin.
        """
        costs = np.full((num_nodes, 3, self.num_bins - 1), np.inf)
        for axis in range(3):
            key = row * self.num_bins + bins[:, axis]
            size = num_nodes * self.num_bins
            count = np.bincount(key, minlength=size).reshape(num_nodes, -1)
            low = np.full((3, size), np.inf, np.float32)
            high = np.full((3, size), -np.inf, np.float32)
            for k in range(3):
                np.minimum.at(low[k], key, self.low[triangle, k])
                np.maximum.at(high[k], key, self.high[triangle, k])
            low, high = (box.reshape(3, num_nodes, -1) for box in (low, high))
            left = _running_cost(count, low, high)[:, :-1]
            right = _running_cost(count[:, ::-1], low[..., ::-1], high[..., ::-1])[:, -2::-1]
            both_halves = (left > -1) & (right > -1)
            costs[:, axis] = np.where(both_halves, left + right, np.inf)
        flat = costs.reshape(num_nodes, -1)
        best = np.argmin(flat, axis=1)
        axis, last_bin = np.divmod(best, self.num_bins - 1)
        return axis, last_bin, flat[np.arange(num_nodes), best]


def _running_cost(count, low, high):
    """Return area x triangles of all bins up to each, (nodes, bins); -1 without triangles."""
    total = np.cumsum(count, axis=1)
    low, high = np.minimum.accumulate(low, axis=2), np.maximum.accumulate(high, axis=2)
    filled = total > 0
    extent = np.where(filled, high, 0).astype(np.float64) - np.where(filled, low, 0)
    x, y, z = extent
    return np.where(filled, total * (x * y + y * z + z * x), -1.0)
