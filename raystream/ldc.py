"""Method `ldc`: rays through the layered depth cube of Buerger et al. (2007), cl/ldc.cl.

A ray hits samples: image-accurate, fast where triangles are small, and blind to what falls between
them. As published (``tolerance=0.001``) those that it comes close to; by default those whose piece
of their triangle's plane, as large as a texel, it meets. With ``exact=True`` the triangles of the
samples that a ray may meet are intersected: hits equal those of `brute`.
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
# A triangle's slopes in its image are at most 1 along both sides of a texel.
_PLANE_REACH = 1.0  # texels that its depth within one is from the sample's, at most
_HALF_ULP = 2.0**-12  # of a depth of 16 bits


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
        Hits equal those of `brute` bit for bit. Otherwise those of samples.
    tolerance : float or None
        A number: as published, a ray hits a sample whose depth is within this of the ray's depths
        over the sample's texel, and is shaded from there. In parts of the diagonal of the scene's
        bounding box; the paper's 0.001 is in the units of its scenes. A surface may be met that
        much early, and beside its rim. None: a ray hits a sample where it meets the plane of the
        sample's triangle within its texel. Either way not hit is the surface on which a ray starts
        or ends: triangles whose plane is within a texel (and the tolerance) of org + tnear dir, or
        org + tfar dir. Not used where `exact`.
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
    `Statistics.final_tests` counts triangles intersected with a ray (not `exact`: samples close to
    it), `final_hits` those hit within the ray's segment as far as it then reached: every hit
    ends it, so these depend on the order of traversal and are fewer than those of `brute`.
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit,
        resolution=512,
        exact=False,
        tolerance=None,
        builder="a-buffer",
        block=16,
        depth="full",
    ):
        check_options(resolution, exact, builder, block, depth)
        if tolerance is not None:
            wanted = "a part of the scene's diagonal, at least 0"
            tolerance = check_number("tolerance", tolerance, lambda x: x >= 0, wanted)
        self.tolerance = tolerance
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
        self.session.launch(
            TRAVERSAL,
            self._kernels(cube)[kernel],
            groups,
            np.uint32(len(rays)),
            np.uint32(self.geometry.num_triangles),
            np.int32(cube.resolution),
            cltypes.make_int2(*cube.block),
            cltypes.make_float2(*self._reach(cube)),
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
        points = {} if self.tolerance is None or cube.exact else {"POINTS": 1}
        return self.session.kernels("ldc.cl", RAYS=_RAYS, **points, **cube.defines())

    def _reach(self, cube):
        """How far from a ray's depths a sample's may be: in diagonals of the scene, in texels."""
        if cube.exact:
            return 0.0, 0.0
        if self.tolerance is not None:
            return self.tolerance, 0.0
        rounding = cube.resolution * _HALF_ULP if cube.depth == "half" else 0.0
        return 0.0, _PLANE_REACH + rounding
