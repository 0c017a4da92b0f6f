"""The two-level layered depth cube of Buerger et al. (2007), cl/cube.cl: what `ldc` traces.

The scene is sampled along three axes, on a grid over the cube around its bounding box. As
published, a triangle is sampled at the texels' centres; with ``exact=True`` in every texel that it
touches, where a sample holds the interval of its depths.
"""

import dataclasses
import math

import numpy as np
import pyopencl as cl
import pyopencl.array as cla

from raystream import device, intersect
from raystream.checks import check_choice, check_count
from raystream.errors import MemoryLimitError
from raystream.geometry import Geometry
from raystream.intersect import HitStream
from raystream.rays import Rays
from raystream.scan import scan
from raystream.scene import as_scene
from raystream.shade import Shader
from raystream.statistics import HIERARCHY_CREATION

BUILDERS = ("a-buffer", "peeling")
DEPTHS = {"full": np.float32, "half": np.float16}
MAX_RESOLUTION = 16384  # texels have 32-bit numbers, and half depths end at 65,504
_TRIANGLES = 64  # to a work-item, see cl/cube.cl
_CHUNKS_PER_UNIT = 16
_COUNT_BYTES = 4  # a texel's number of samples, or its first
_BLOCK_BYTES = 16  # two depths and the occupied slabs
_PADDING = 16  # depths are read sixteen at a time
_FRAGMENT = np.dtype([("near", np.float32), ("far", np.float32), ("triangle", np.uint32)])


@dataclasses.dataclass
class Samples:
    """The samples of a cube, in ascending order of depth, then triangle, within a texel.

    Attributes
    ----------
    near : Array of shape (n + 16,) float32, or float16 for half depths
        Depth in texels; of an exact cube the smallest over the texel. The last 16 are padding.
    far : Array of shape (n + 16,), or None
        The largest depth over the texel; of exact cubes only.
    triangle : Array of shape (n,) uint32
        Flat number of the scene.
    """

    near: cla.Array
    far: cla.Array | None
    triangle: cla.Array

    def __len__(self):
        return self.triangle.shape[0]

    def get(self):
        """On the host: (n,) with fields near, far (of exact cubes) and triangle."""
        arrays = {"near": self.near, "far": self.far, "triangle": self.triangle}
        given = {name: array.get() for name, array in arrays.items() if array is not None}
        host = np.empty(len(self), [(name, array.dtype) for name, array in given.items()])
        for name, array in given.items():
            host[name] = array[: len(self)]
        return host

    @property
    def nbytes(self):
        """Bytes of all three."""
        return sum(a.nbytes for a in (self.near, self.far, self.triangle) if a is not None)


@dataclasses.dataclass
class SampleAttributes:
    """What the samples of a cube hold, in their order; all are device arrays.

    Attributes
    ----------
    depth : (n,) float32
        Along the direction's axis from the cube's low corner, in the scene's unit; of an exact
        cube the smallest over the texel.
    normal : (n, 4) float32
        Shading normal, unit length, against the direction of view; the fourth component unused.
    colour : (n, 4) float32
        Linear RGB of the surface under white light; the fourth component unused.
    prim_id, geom_id : (n,) int32
    """

    depth: cla.Array
    normal: cla.Array
    colour: cla.Array
    prim_id: cla.Array
    geom_id: cla.Array


class LayeredDepthCube:
    """Three layered depth images of a geometry along the axes, and their coarse blocks.

    Direction d looks along axis d; the columns of its image are axis (d + 1) % 3, its rows
    (d + 2) % 3. Depths are counted in texels from the low corner of the cube.

    One thing is read back while building, the number of samples (and of layers): memory must be had
    for them.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int or None
        Bytes that the cube may take: `nbytes`, without what only building needs.
    resolution : int
        Texels along each edge of the cube, at most 16384.
    exact : bool
        Sample conservatively: all triangles that touch a texel, with the interval of their depths.
    builder : {"a-buffer", "peeling"}
        All samples at once, then sorted texel by texel; or layer by layer, as published. Both give
        the same samples in the same order.
    block : int, (int, int) or None
        Columns and rows of texels to a block of the coarse level, one number: as many of both;
        None: one block for all, no coarse level.
    depth : {"full", "half"}
        Bits of a depth: 32, or 16, of which 11 count: half a texel in the far half of 1024. Those
        of exact cubes are rounded outwards, so that they lose no hit.

    Attributes
    ----------
    resolution : int
    block : (int, int)
        Columns and rows of texels to a block.
    exact : bool
    depth : str
    num_samples : int
    first : Array of shape (3 * resolution**2 + 1,) uint32
        Texel [d][column][row] has the samples first[i] .. first[i + 1] - 1.
    samples : Samples
    blocks : Array of shape (3, across, along, 2) float32
        Smallest and largest depth within each block of texels, [d][column][row]; inf, -inf where it
        is empty.
    slabs : Array of shape (3, across, along) uint64
        Which of 64 slabs of the cube's depth are occupied within each block, the lowest bit first.
    grid : Array of shape (2, 4) float32
        Low corner and texels per unit; the bounding box's diagonal, a texel's edge, unused.
    nbytes : int
        Bytes of `samples`, `first`, `blocks` and `slabs`.

    Raises
    ------
    ValueError
        An option that there is not.
    raystream.errors.MemoryLimitError
        The cube needs more than `memory_limit`; names a resolution that does not.
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit=None,
        resolution=512,
        exact=False,
        builder="a-buffer",
        block=16,
        depth="full",
    ):
        check_options(resolution, exact, builder, block, depth)
        self.session, self.geometry = session, geometry
        self.resolution, self.exact, self.depth = int(resolution), exact, depth
        self.block = _block_of(block, self.resolution)
        self._limit, self._builder = memory_limit, builder
        self._chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self._kernels = session.kernels("cube.cl", CHUNKS=self._chunks, **self.defines())
        self._groups = -(-geometry.num_triangles // _TRIANGLES)
        self._build()

    @classmethod
    def build(cls, scene, resolution=512, **options):
        """The cube of a scene, on the default device.

        Parameters
        ----------
        scene : raystream.Scene, trimesh.Trimesh or trimesh.Scene
        resolution : int
        **options
            ``exact``, ``builder``, ``block``, ``depth``, ``memory_limit`` as of the class.
        """
        session = device.session()
        cube = cls(session, Geometry(session, as_scene(scene)), resolution=resolution, **options)
        session.finish()
        return cube

    @property
    def layers(self):
        """(3,) int: the most samples of a texel in each direction, its depth complexity."""
        return self._measures[1:].astype(int)

    @property
    def bytes_per_triangle(self):
        """`nbytes` for each triangle of the scene."""
        return self.nbytes / max(1, self.geometry.num_triangles)

    @property
    def bytes_per_texel(self):
        """`nbytes` for each texel of the three images."""
        return self.nbytes / (3 * self.resolution**2)

    def attributes(self, scene):
        """What every sample holds, computed from its texel, depth and triangle.

        Samples store no more than these (a visibility buffer): a hit is shaded from its sample by
        the same computation, so only hits pay for it.

        Parameters
        ----------
        scene : raystream.Scene, trimesh.Trimesh or trimesh.Scene
            The one that the cube is of: its materials, normals, colours.

        Returns
        -------
        SampleAttributes
        """
        session, count = self.session, self.num_samples
        depth, u, v = (session.empty(count, np.float32) for _ in range(3))
        views, weights, image = (session.empty((count, 4), np.float32) for _ in range(3))
        for array in (weights, image):
            session.fill(HIERARCHY_CREATION, array, 0)
        self._launch(
            "place_samples", self._chunks, np.int32(self.resolution), self.grid,
            self.geometry.triangles, self.first, self.samples.near, self.samples.triangle,
            depth, u, v, views,
        )  # fmt: skip
        hits = HitStream(depth, self.samples.triangle, u, v)
        shader = Shader(session, self.geometry, as_scene(scene))
        surfaces = shader.evaluate(hits, Rays(weights, views), weights, image)
        geom_id, prim_id = intersect.split_ids(session, hits, self.geometry)
        return SampleAttributes(depth, surfaces.shading, surfaces.base, prim_id, geom_id)

    def defines(self):
        """Build-time constants of cl/cube.h for this cube."""
        chosen = {"CONSERVATIVE": self.exact, "HALF_DEPTH": self.depth == "half"}
        return {name: 1 for name, wanted in chosen.items() if wanted}

    def _build(self):
        self.grid = self._grid(self.resolution)
        self._check_limit(self.resolution, 0)
        counts = self._counts(self.resolution, self.grid)
        self._measures = self._measure(self.resolution, counts)
        self.num_samples = int(self._measures[0])
        self._check_limit(self.resolution, self.num_samples)
        self.nbytes = self._bytes(self.resolution, self.num_samples)
        self.first = self.session.empty(counts.shape, np.uint32)
        with self.session.clock.under(HIERARCHY_CREATION):
            scan(self.session, counts, self.first)
        depths = self.num_samples + _PADDING, DEPTHS[self.depth]
        self.samples = Samples(
            near=self.session.empty(*depths),
            far=self.session.empty(*depths) if self.exact else None,
            triangle=self.session.empty(self.num_samples, np.uint32),
        )
        if self._builder == "a-buffer":
            self._scatter(counts)
        else:
            self._peel()
        self._build_blocks()

    def _build_blocks(self):
        shape = 3, *_blocks_across(self.resolution, self.block)
        self.blocks = self.session.empty((*shape, 2), np.float32)
        self.slabs = self.session.empty(shape, np.uint64)
        sizes = map(np.uint32, (self.resolution, *self.block, *shape[1:]))
        arrays = self.first, self.samples.near, self.samples.far, self.blocks, self.slabs
        self._launch("build_blocks", shape[0] * shape[1], *sizes, *arrays)

    def _grid(self, resolution):
        boxes = self.session.empty((self._chunks, 2, 4), np.float32)
        grid = self.session.empty((2, 4), np.float32)
        count = np.uint32(self.geometry.num_triangles)
        self._launch("measure_box", self._chunks, count, self.geometry.triangles, boxes)
        self._launch("make_grid", 1, np.uint32(resolution), boxes, grid)
        return grid

    def _counts(self, resolution, grid):
        """Samples of each texel; 0 beyond the last."""
        counts = self.session.empty(3 * resolution**2 + 1, np.uint32)
        self.session.fill(HIERARCHY_CREATION, counts, 0)
        self._launch_triangles("count_samples", resolution, grid, counts)
        return counts

    def _measure(self, resolution, counts):
        """Number of samples, and the most of a texel in each direction: the one read-back."""
        measures = self.session.empty((self._chunks + 1, 4), np.uint64)
        self._launch("measure_counts", self._chunks, np.uint32(resolution**2), counts, measures)
        self._launch("sum_measures", 1, measures)
        host = np.empty(measures.shape, np.uint64)
        cl.enqueue_copy(self.session.queue, host, measures.base_data)
        return host[-1]

    def _scatter(self, counts):
        fragments = self.session.empty(self.num_samples, _FRAGMENT)
        self._launch_triangles(
            "scatter_samples", self.resolution, self.grid, counts, self.first, fragments
        )
        texels = np.uint32(3 * self.resolution**2)
        samples = self.samples.near, self.samples.far, self.samples.triangle
        self._launch("sort_texels", self._chunks, texels, self.first, fragments, *samples)

    def _peel(self):
        last, following = (self.session.empty(len(self.first), np.uint64) for _ in range(2))
        samples = self.samples.near, self.samples.far, self.samples.triangle
        for layer in range(int(self.layers.max()) + 1):
            self.session.fill(HIERARCHY_CREATION, following, 0xFFFFFFFFFFFFFFFF)
            self._launch(
                "peel_layer", self._groups, np.uint32(self.geometry.num_triangles),
                np.int32(self.resolution), np.uint32(layer), self.grid, self.geometry.triangles,
                self.first, last, following, *samples,
            )  # fmt: skip
            last, following = following, last

    def _launch_triangles(self, kernel, resolution, grid, *args):
        counts = np.uint32(self.geometry.num_triangles), np.int32(resolution)
        self._launch(kernel, self._groups, *counts, grid, self.geometry.triangles, *args)

    def _launch(self, kernel, size, *args):
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], size, *args)

    # ---- memory ----

    def _bytes(self, resolution, samples):
        depths = (samples + _PADDING) * np.dtype(DEPTHS[self.depth]).itemsize
        texels, (across, along) = 3 * resolution**2, _blocks_across(resolution, self.block)
        return (
            depths * (2 if self.exact else 1) + 4 * samples  # and their triangles
            + _COUNT_BYTES * (texels + 1) + _BLOCK_BYTES * 3 * across * along
        )  # fmt: skip

    def _check_limit(self, resolution, samples):
        """Refuse before the memory is taken; samples have 32-bit numbers, too."""
        needed = self._bytes(resolution, samples)
        limit = math.inf if self._limit is None else self._limit
        if needed <= limit and samples < 2**32:
            return
        fits = self._fitting(resolution, needed, limit)
        wanted = f"resolution {resolution} needs {needed} bytes"
        if needed <= limit:
            wanted = f"resolution {resolution} needs {samples} samples, 2**32 is the most"
        advice = "no resolution fits" if fits is None else f"resolution {fits} fits"
        bound = "" if self._limit is None else f" of memory_limit {self._limit}"
        raise MemoryLimitError(f"layered depth cube: {wanted}{bound}; {advice}")

    def _fitting(self, resolution, needed, limit):
        """A resolution that fits, found by counting its samples; None where there is none."""
        limit = min(limit, self._bytes(resolution, 2**32 - 1))
        while resolution > 1:
            # Samples grow with the square of the resolution, or slower.
            guess = int(resolution * min(0.95, math.sqrt(limit / needed)))
            resolution = max(1, guess)
            needed = self._bytes(resolution, 0)
            if needed <= limit:
                counts = self._counts(resolution, self._grid(resolution))
                needed = self._bytes(resolution, int(self._measure(resolution, counts)[0]))
            if needed <= limit:
                return resolution
        return None


def check_options(resolution, exact, builder, block, depth):
    """Refuse by name what is no option of a cube."""
    check_count("resolution", resolution)
    if resolution > MAX_RESOLUTION:
        raise ValueError(f"resolution: need at most {MAX_RESOLUTION}, got {resolution}")
    check_choice("exact", exact, (True, False))
    check_choice("builder", builder, BUILDERS)
    check_choice("depth", depth, tuple(DEPTHS))
    if isinstance(block, tuple) and len(block) != 2:
        raise ValueError(f"block: need columns and rows, got {len(block)} numbers")
    for edge in block if isinstance(block, tuple) else () if block is None else (block,):
        check_count("block", edge)


def _block_of(block, resolution):
    """(columns, rows) of texels of the option `block`, no more than there are."""
    edges = block if isinstance(block, tuple) else (block or resolution,) * 2
    return tuple(min(int(edge), resolution) for edge in edges)


def _blocks_across(resolution, block):
    return tuple(-(-resolution // edge) for edge in block)
