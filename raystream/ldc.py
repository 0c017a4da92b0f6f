"""Method `ldc`: the two-level layered depth cube of Buerger et al. (2007), cl/ldc.cl.

The scene is sampled along three axes, on a grid over the cube around its bounding box; rays walk
through these images. As published, a ray hits a sample that it comes close to: image-accurate, fast
where triangles are small, and blind to what falls between the samples. With ``exact=True`` every
triangle is sampled in every texel that it touches, samples hold the interval of its depths there,
and the triangles of samples that a ray may meet are intersected: hits equal those of `brute`.
"""

import math

import numpy as np
import pyopencl as cl

from raystream import device, intersect
from raystream.checks import check_choice, check_count, check_number
from raystream.errors import MemoryLimitError
from raystream.geometry import Geometry
from raystream.intersect import HitStream
from raystream.scan import scan
from raystream.scene import as_scene
from raystream.statistics import FINAL_INTERSECTION, HIERARCHY_CREATION, TRAVERSAL, Statistics

BUILDERS = ("a-buffer", "peeling")
MAX_RESOLUTION = 16384  # texels have 32-bit numbers
_TRIANGLES = 64  # to a work-item, see cl/ldc.cl
_RAYS = 64
_CHUNKS_PER_UNIT = 16
_LOCAL = 64
_COUNT_BYTES = 4  # a texel's number of samples, or its first
_BLOCK_BYTES = 16  # two depths and the occupied slabs
_POINT = np.dtype([("near", np.float32), ("triangle", np.uint32)])
_INTERVAL = np.dtype([("near", np.float32), ("far", np.float32), ("triangle", np.uint32)])


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
    block : int or None
        Edge of the coarse level's blocks in texels; None: one block for all, no coarse level.

    Attributes
    ----------
    resolution, block : int
    exact : bool
    num_samples : int
    first : Array of shape (3 * resolution**2 + 1,) uint32
        Texel [d][column][row] has the samples first[i] .. first[i + 1] - 1.
    samples : Array of shape (num_samples,)
        Fields ``near``, ``far`` (exact only) and ``triangle`` (flat number of the scene), in
        ascending order of depth, then triangle, within a texel.
    blocks : Array of shape (3, n, n, 2) float32
        Smallest and largest depth within each block of texels; inf, -inf where it is empty.
    slabs : Array of shape (3, n, n) uint64
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
        block=8,
    ):
        check_options(resolution, exact, builder, block)
        self.session, self.geometry = session, geometry
        self.resolution, self.exact = int(resolution), exact
        self.block = min(block or self.resolution, self.resolution)
        self._limit, self._builder = memory_limit, builder
        self._chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
        self._kernels = session.kernels("ldc.cl", **self.defines())
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
            ``exact``, ``builder``, ``block``, ``memory_limit`` as of the class.
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

    def defines(self):
        """Build-time constants of cl/ldc.cl for this cube."""
        constants = {"CHUNKS": self._chunks, "RAYS": _RAYS}
        return {**constants, "CONSERVATIVE": 1} if self.exact else constants

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
        self.samples = self.session.empty(self.num_samples, _INTERVAL if self.exact else _POINT)
        if self._builder == "a-buffer":
            self._scatter(counts)
        else:
            self._peel()
        across = -(-self.resolution // self.block)
        self.blocks = self.session.empty((3, across, across, 2), np.float32)
        sizes = self.resolution, self.block, across
        self.slabs = self.session.empty((3, across, across), np.uint64)
        arrays = self.first, self.samples, self.blocks, self.slabs
        self._launch("build_blocks", 3 * across, *map(np.uint32, sizes), *arrays)

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
        self._launch_triangles(
            "scatter_samples", self.resolution, self.grid, counts, self.first, self.samples
        )
        texels = np.uint32(3 * self.resolution**2)
        self._launch("sort_texels", self._chunks, texels, self.first, self.samples)

    def _peel(self):
        last, following = (self.session.empty(len(self.first), np.uint64) for _ in range(2))
        for layer in range(int(self.layers.max()) + 1):
            self.session.fill(HIERARCHY_CREATION, following, 0xFFFFFFFFFFFFFFFF)
            self._launch(
                "peel_layer", self._groups, np.uint32(self.geometry.num_triangles),
                np.int32(self.resolution), np.uint32(layer), self.grid, self.geometry.triangles,
                self.first, last, following, self.samples,
            )  # fmt: skip
            last, following = following, last

    def _launch_triangles(self, kernel, resolution, grid, *args):
        counts = np.uint32(self.geometry.num_triangles), np.int32(resolution)
        self._launch(kernel, self._groups, *counts, grid, self.geometry.triangles, *args)

    def _launch(self, kernel, size, *args):
        self.session.launch(HIERARCHY_CREATION, self._kernels[kernel], size, *args)

    # ---- memory ----

    def _bytes(self, resolution, samples):
        texels, across = 3 * resolution**2, -(-resolution // self.block)
        sample = (_INTERVAL if self.exact else _POINT).itemsize
        return sample * samples + _COUNT_BYTES * (texels + 1) + _BLOCK_BYTES * 3 * across**2

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


def check_options(resolution, exact, builder, block):
    """Refuse by name what is no option of a cube."""
    check_count("resolution", resolution)
    if resolution > MAX_RESOLUTION:
        raise ValueError(f"resolution: need at most {MAX_RESOLUTION}, got {resolution}")
    check_choice("exact", exact, (True, False))
    check_choice("builder", builder, BUILDERS)
    if block is not None:
        check_count("block", block)


class LayeredDepthCubeTracer:
    """Rays through a layered depth cube, which is made anew when the geometry has changed.

    Parameters
    ----------
    session : raystream.device.Session
    geometry : raystream.geometry.Geometry
    memory_limit : int
        Bytes that the cube may take.
    resolution : int
        Texels along each edge of the cube; 512 or 1024 in the paper.
    exact : bool
        Hits equal those of `brute` bit for bit. Otherwise as published.
    tolerance : float
        Published mode: a ray hits a sample whose depth is within this of the ray's depths over
        the sample's texel. In parts of the diagonal of the scene's bounding box; the paper's 0.001
        is in the units of its scenes. A surface may be met that much early, and beside its rim. Not
        hit is the surface on which a ray starts or ends: triangles whose plane is within a texel
        and the tolerance of org + tnear dir, or org + tfar dir. Not used where `exact`.
    builder : {"a-buffer", "peeling"}
        How the cube is made: see `LayeredDepthCube`.
    block : int or None
        Edge of the coarse level's blocks in texels; None: no coarse level.

    Raises
    ------
    ValueError
        An option that there is not.
    raystream.errors.MemoryLimitError
        At the first ray traced: see `LayeredDepthCube`.

    Notes
    -----
    `Statistics.final_tests` counts triangles intersected with a ray (published mode: samples close
    to it), `final_hits` those hit within the ray's segment as far as it then reached: every hit
    ends it, so these depend on the order of traversal and are fewer than those of `brute`.
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit,
        resolution=512,
        exact=False,
        tolerance=0.001,
        builder="a-buffer",
        block=8,
    ):
        check_options(resolution, exact, builder, block)
        wanted = "a part of the scene's diagonal, at least 0"
        self.tolerance = check_number("tolerance", tolerance, lambda x: x >= 0, wanted)
        self.session, self.geometry = session, geometry
        self._options = (memory_limit, resolution, exact, builder, block)
        self._cube, self._version = None, None

    def cube(self):
        """The `LayeredDepthCube` of the geometry as it is now."""
        if self._version != self.geometry.version:
            self._cube = None  # its memory may be needed
            self._cube = LayeredDepthCube(self.session, self.geometry, *self._options)
            self._version = self.geometry.version
        return self._cube

    def intersect(self, rays):
        """Closest hits of `rays`; returns (HitStream, Statistics)."""
        cube = self.cube()
        closest = self.session.empty(len(rays), np.uint64)
        statistics = self._trace(cube, "intersect_ldc", rays, closest)
        if cube.exact:
            hits = intersect.resolve(self.session, closest, rays, self.geometry.triangles)
        else:
            hits = self._resolve(cube, closest, rays)
        return hits, statistics

    def occluded(self, rays):
        """Whether anything lies in each ray's segment; returns (uint8 Array, Statistics)."""
        blocked = self.session.empty(len(rays), np.uint8)
        return blocked, self._trace(self.cube(), "occlude_ldc", rays, blocked)

    def _trace(self, cube, kernel, rays, result):
        groups = -(-len(rays) // _RAYS)
        counts = self.session.empty((groups, 3), np.uint64)
        tolerance = 0.0 if cube.exact else self.tolerance
        self.session.launch(
            TRAVERSAL,
            self.session.kernels("ldc.cl", **cube.defines())[kernel],
            groups,
            np.uint32(len(rays)),
            np.uint32(self.geometry.num_triangles),
            np.int32(cube.resolution),
            np.int32(cube.block),
            np.int32(cube.blocks.shape[1]),
            np.float32(tolerance),
            cube.grid,
            cube.first,
            cube.samples,
            cube.slabs,
            rays.org_tnear,
            rays.dir_tfar,
            self.geometry.triangles,
            result,
            counts,
        )
        active, tests, hits = (int(x) for x in counts.get().sum(axis=0, dtype=np.uint64))
        return Statistics(
            final_tests=tests,
            final_hits=hits,
            rays=active,
            triangles=self.geometry.num_triangles,
            batches=1,
        )

    def _resolve(self, cube, closest, rays):
        hits = HitStream.empty(self.session, len(rays))
        self.session.launch(
            FINAL_INTERSECTION,
            self.session.kernels("ldc.cl", **cube.defines())["resolve_samples"],
            len(rays),
            np.uint32(len(rays)),
            closest,
            rays.org_tnear,
            rays.dir_tfar,
            self.geometry.triangles,
            hits.t,
            hits.triangle,
            hits.u,
            hits.v,
            local=_LOCAL,
        )
        return hits
