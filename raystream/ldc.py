"""Method `ldc`: rays through the layered depth cube of Buerger et al. (2007), cl/ldc.cl.

As published, a ray hits a sample that it comes close to: image-accurate, fast where triangles are
small, and blind to what falls between the samples. With ``exact=True`` the triangles of the samples
that a ray may meet are intersected: hits equal those of `brute`.
"""

import numpy as np
import pyopencl.cltypes as cltypes

from raystream import intersect
from raystream.checks import check_number
from raystream.cube import LayeredDepthCube, check_options
from raystream.intersect import HitStream
from raystream.statistics import FINAL_INTERSECTION, TRAVERSAL, Statistics

_RAYS = 64  # to a work-item
_LOCAL = 64


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
    block : int, (int, int) or None
        Columns and rows of texels to a block of the coarse level; None: no coarse level.
    depth : {"full", "half"}
        Bits of the samples' depths: see `LayeredDepthCube`.

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
        block=16,
        depth="full",
    ):
        check_options(resolution, exact, builder, block, depth)
        wanted = "a part of the scene's diagonal, at least 0"
        self.tolerance = check_number("tolerance", tolerance, lambda x: x >= 0, wanted)
        self.session, self.geometry = session, geometry
        self._options = (memory_limit, resolution, exact, builder, block, depth)
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
            self._kernels(cube)[kernel],
            groups,
            np.uint32(len(rays)),
            np.uint32(self.geometry.num_triangles),
            np.int32(cube.resolution),
            cltypes.make_int2(*cube.block),
            np.float32(tolerance),
            cube.grid,
            cube.first,
            cube.samples.near,
            cube.samples.far,
            cube.samples.triangle,
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
            structure_bytes=cube.nbytes,
            texels=3 * cube.resolution**2,
        )

    def _resolve(self, cube, closest, rays):
        hits = HitStream.empty(self.session, len(rays))
        self.session.launch(
            FINAL_INTERSECTION,
            self._kernels(cube)["resolve_samples"],
            len(rays),
            np.uint32(len(rays)),
            np.int32(cube.resolution),
            cube.grid,
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

    def _kernels(self, cube):
        return self.session.kernels("ldc.cl", RAYS=_RAYS, **cube.defines())
