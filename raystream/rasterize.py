"""Primary visibility by rasterisation: the hits of the camera's rays (``cl/rasterize.cl``)."""

import dataclasses
import math

import numpy as np
import pyopencl as cl
import pyopencl.array

from raystream.statistics import RASTERISATION

TILE = 32  # edge of a tile in pixels
CROWDED = 4096  # triangles in a tile beyond which it is cut into bands
BANDS = 4
TINY = 2  # pixels of a bounding box up to which they are tested before binning
_CHUNKS_PER_UNIT = 16  # chunks of triangles per compute unit when binning
_TASKS_PER_UNIT = 8  # work-items that share the tiles, per compute unit
_MAX_SIZE = 65535  # pixel bounds are 16 bits
_INDEX_BYTES = 4


@dataclasses.dataclass(frozen=True)
class PrimaryHits:
    """What each pixel's ray meets first; device arrays of height * width, top row first.

    Attributes
    ----------
    prim : pyopencl.array.Array of uint32
        Triangle, 0xffffffff where there is none.
    t : pyopencl.array.Array of float32
        Depth along the camera's forward direction, inf where there is no triangle.
    u, v : pyopencl.array.Array of float32
        The hit is (1 - u - v) v0 + u v1 + v v2; 0 where there is no triangle.
    """

    prim: cl.array.Array
    t: cl.array.Array
    u: cl.array.Array
    v: cl.array.Array


class Rasterizer:
    """Finds the triangle that each pixel's ray meets first; keeps its buffers between frames.

    Parameters
    ----------
    session : raystream.device.Session
    list_bytes : int, optional
        Largest buffer for the list of (tile, triangle) entries; default: what the device can
        allocate at once. Triangles that need more are drawn in batches, with the same result.
    """

    def __init__(self, session, list_bytes=None):
        self._session = session
        self._kernels = session.kernels(
            "rasterize.cl", TILE=TILE, BANDS=BANDS, CROWDED=CROWDED, TINY=TINY
        )
        largest = session.device.max_mem_alloc_size
        self._max_entries = min(list_bytes or largest, largest, 2**32 - 1) // _INDEX_BYTES
        self._buffers = {}

    def render(self, triangles, camera, size, offset=(0.5, 0.5), num_triangles=None):
        """The first triangle at each pixel, seen from both sides.

        Parameters
        ----------
        triangles : pyopencl.array.Array of float32, shape (M, 12)
            Corners v0, v1, v2 as x, y, z, unused; M may be 0. A triangle with a coordinate that is
            not finite is not drawn.
        camera : object
            With ``eye`` (3,), ``basis`` -> unit vectors (right, up, forward), ``fov_y`` in degrees.
        size : (int, int)
            Width and height in pixels, at most 65535.
        offset : (float, float)
            Where in its pixel a ray passes, from the top left corner.
        num_triangles : int, optional
            Draw only the first of them; default M.

        Returns
        -------
        PrimaryHits
            Overwritten by the next call of the same size.

        Raises
        ------
        ValueError
            `size`, `triangles` or `num_triangles` is not as described.
        """
        width, height = size
        if not (0 < width <= _MAX_SIZE and 0 < height <= _MAX_SIZE):
            raise ValueError(f"size: need 1 to {_MAX_SIZE} pixels each way, got {width}x{height}")
        if triangles.dtype != np.float32 or triangles.shape[1:] != (12,):
            raise ValueError(
                f"triangles: need float32 (M, 12), got {triangles.dtype} {triangles.shape}"
            )
        count = len(triangles) if num_triangles is None else num_triangles
        if not 0 <= count <= len(triangles):
            raise ValueError(f"num_triangles: need 0 to {len(triangles)}, got {count}")
        hits = self._hits(width * height)
        frame = _Frame(triangles, _view(camera, size, offset), size, hits)
        self._draw(frame, 0, count)
        return hits

    def _draw(self, frame, first, last):
        """Draw triangles `first` to `last` over the earlier ones, in halves where they need it."""
        length = self._count(frame, first, last)
        if length > self._max_entries and last - first > 1:
            middle = (first + last) // 2
            self._draw(frame, first, middle)
            self._draw(frame, middle, last)
        else:
            self._scatter_and_draw(frame, first, last, length)

    def _count(self, frame, first, last):
        """Count and scan the bins; return the number of entries."""
        chunks, chunk_size = self._chunks(first, last)
        tiles = frame.tiles
        bounds = self._buffer("bounds", 4 * len(frame.triangles), np.uint16)
        counts = self._buffer("counts", chunks * tiles, np.uint32)
        totals = self._buffer("totals", tiles, np.uint32)
        starts = self._buffer("starts", tiles + 1, np.uint32)
        tasks = self._buffer("tasks", 4 * tiles * BANDS, np.uint32)
        length = self._buffer("length", 2, np.uint64)
        launch, kernels = self._session.launch, self._kernels
        launch(RASTERISATION, kernels["count_bins"], chunks, np.uint32(first), np.uint32(last),
               chunk_size, frame.size, *frame.view, np.uint32(tiles), frame.triangles, bounds,
               counts)
        launch(RASTERISATION, kernels["scan_chunks"], tiles, np.uint32(chunks), np.uint32(tiles),
               counts, totals, local=64)
        launch(RASTERISATION, kernels["scan_tiles"], 1, np.uint32(tiles), totals, starts, tasks,
               length, self._buffer("next", 1, np.uint32))
        host = np.empty(2, np.uint64)
        cl.enqueue_copy(self._session.queue, host, length.base_data)
        return int(host[0])

    def _scatter_and_draw(self, frame, first, last, length):
        chunks, chunk_size = self._chunks(first, last)
        tiles = frame.tiles
        entries = self._buffer("list", length, np.uint32)
        b, launch, kernels = self._buffers, self._session.launch, self._kernels
        launch(RASTERISATION, kernels["scatter_bins"], chunks, np.uint32(first), np.uint32(last),
               chunk_size, frame.size, np.uint32(tiles), b["bounds"], b["starts"], b["counts"],
               entries)
        workers = min(tiles, _TASKS_PER_UNIT * self._session.device.max_compute_units)
        hits = frame.hits
        launch(RASTERISATION, kernels["draw_tiles"], workers, frame.size, *frame.view,
               np.int32(first > 0), frame.triangles, b["bounds"], b["starts"], entries, b["tasks"],
               b["length"], b["next"], hits.prim, hits.t, hits.u, hits.v)

    def _chunks(self, first, last):
        """Number of chunks, and of triangles in one."""
        wanted = _CHUNKS_PER_UNIT * self._session.device.max_compute_units
        chunk_size = max(1, -(-(last - first) // wanted))
        return max(1, -(-(last - first) // chunk_size)), np.uint32(chunk_size)

    def _buffer(self, name, length, dtype):
        """The buffer `name`, of at least `length` elements; its contents are lost when it grows."""
        buffer = self._buffers.get(name)
        if buffer is None or buffer.size < length:
            buffer = self._buffers[name] = self._session.empty(max(1, length), dtype)
        return buffer

    def _hits(self, pixels):
        if "hits" not in self._buffers or self._buffers["hits"].t.size != pixels:
            empty = self._session.empty
            self._buffers["hits"] = PrimaryHits(
                empty(pixels, np.uint32), *(empty(pixels, np.float32) for _ in range(3))
            )
        return self._buffers["hits"]


class _Frame:
    """What all the launches of a frame share."""

    def __init__(self, triangles, view, size, hits):
        self.triangles, self.view, self.hits = triangles, view, hits
        self.size = cl.cltypes.make_int2(*size)
        self.tiles = -(-size[0] // TILE) * -(-size[1] // TILE)


def _view(camera, size, offset):
    """The arguments `axes` and `centre` of the kernels.

    The axes are scaled such that X/Z and Y/Z are pixels from the point straight ahead, Y downwards.
    """
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * math.radians(camera.fov_y))
    right, up, forward = (np.asarray(axis, np.float64) for axis in camera.basis)
    axes = np.zeros((4, 4))
    axes[0, :3] = camera.eye
    axes[1:, :3] = np.column_stack([focal * right, -focal * up, forward])
    centre = (0.5 * width - offset[0], 0.5 * height - offset[1])
    return cl.cltypes.make_float16(*axes.ravel()), cl.cltypes.make_float2(*centre)
