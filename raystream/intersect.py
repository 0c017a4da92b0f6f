"""Final ray-triangle intersection and resolving hits (cl/intersect.cl)."""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.pairs import CHUNKS
from raystream.statistics import FINAL_INTERSECTION

_LOCAL = 64
_CHUNKS_PER_UNIT = 8
_MISS = np.uint64(0xFFFFFFFFFFFFFFFF)


@dataclasses.dataclass
class HitStream:
    """Closest hits on the device, one per ray.

    Attributes
    ----------
    t : Array of shape (n,) float32
        inf where missed.
    triangle : Array of shape (n,) uint32
        Flat triangle number of the scene, 0xffffffff where missed.
    u, v : Array of shape (n,) float32
        Weights of the triangle's second and third vertex, 0 where missed.
    """

    t: cla.Array
    triangle: cla.Array
    u: cla.Array
    v: cla.Array

    @classmethod
    def empty(cls, session, count):
        """Uninitialised hits of `count` rays."""
        types = (np.float32, np.uint32, np.float32, np.float32)
        return cls(*(session.empty(count, t) for t in types))

    @classmethod
    def unpack(cls, session, records):
        """Hits of records, (n, 4) float32: t, u, v and the triangle's bits."""
        count = records.shape[0]
        hits = cls.empty(session, count)
        fields = hits.t, hits.triangle, hits.u, hits.v
        _launch(session, "unpack_hits", np.uint32(count), records, *fields)
        return hits


def no_hits(session, count):
    """The key of every ray set to a miss: where `intersect_pairs` starts from."""
    closest = session.empty(count, np.uint64)
    session.fill(FINAL_INTERSECTION, closest, _MISS)
    return closest


def not_blocked(session, count):
    """The flag of every ray set to free: where `occlude_pairs` starts from."""
    blocked = session.empty(count, np.uint8)
    session.fill(FINAL_INTERSECTION, blocked, 0)
    return blocked


def test_pairs(session, kernel, pairs, rays_per_node, slots, rays, triangles, result, traversal):
    """Run `kernel` ("intersect_pairs" or "occlude_pairs") over the last stream of a traversal."""
    kernels = session.kernels("intersect.cl", CHUNKS=CHUNKS)
    reduction = traversal.reduction
    session.launch(
        FINAL_INTERSECTION,
        kernels[kernel],
        CHUNKS,
        pairs.length,
        pairs.pairs,
        np.uint32(rays_per_node),
        np.uint32(slots.shape[0]),
        slots,
        rays.org_tnear,
        rays.dir_tfar,
        triangles,
        result,
        reduction.chunk_tests,
        reduction.chunk_hits,
    )
    session.launch(
        FINAL_INTERSECTION,
        kernels["sum_final"],
        1,
        pairs.length,
        reduction.chunk_tests,
        reduction.chunk_hits,
        traversal.counts,
        np.uint32(traversal.counts.shape[0] - 1),
    )


def resolve(session, closest, rays, triangles):
    """Hits from the keys that `intersect_pairs` or `intersect_brute` left."""
    hits = HitStream.empty(session, len(rays))
    session.launch(
        FINAL_INTERSECTION,
        session.kernels("intersect.cl", CHUNKS=CHUNKS)["resolve_hits"],
        len(rays),
        np.uint32(len(rays)),
        closest,
        rays.org_tnear,
        rays.dir_tfar,
        triangles,
        hits.t,
        hits.triangle,
        hits.u,
        hits.v,
        local=_LOCAL,
    )
    return hits


def split_ids(session, hits, geometry):
    """(geom_id, prim_id) of the hits, int32 arrays of shape (n,), -1 where missed."""
    count = hits.triangle.shape[0]
    geom_id, prim_id = session.empty(count, np.int32), session.empty(count, np.int32)
    _launch(
        session,
        "split_ids",
        np.uint32(count),
        np.uint32(geometry.first_prims.shape[0] - 1),
        hits.triangle,
        geometry.geom_ids,
        geometry.first_prims,
        geom_id,
        prim_id,
    )
    return geom_id, prim_id


def sum_counts(session, counts):
    """The sums of the columns of counts, (n, k) uint64: uint64 numpy, there when the queue is done.

    On the host, of a thousand rows, they would take 0.2 ms.
    """
    sums = session.empty(counts.shape[1], np.uint64)
    sizes = map(np.uint32, counts.shape)
    kernel = _kernels(session)["sum_counts"]
    session.launch(FINAL_INTERSECTION, kernel, 1, *sizes, counts, sums)
    return session.fetch(FINAL_INTERSECTION, sums)


def _launch(session, kernel, *args):
    """Run a kernel of this file, a work-item for each chunk."""
    session.launch(FINAL_INTERSECTION, _kernels(session)[kernel], _chunks(session), *args)


def _chunks(session):
    return _CHUNKS_PER_UNIT * session.device.max_compute_units


def _kernels(session):
    return session.kernels("intersect.cl", CHUNKS=_chunks(session))
