"""Hashes of rays, for the coherent ray-space hierarchy (cl/hash.cl)."""

import numpy as np

from raystream.statistics import RAY_CREATION

# Bits of every part of a key (cl/hash.cl), chosen by measured total tests. More bits of the ends or
# of the fine direction save 0.5 % of the tests and cost another pass of the sort.
HASHES = {
    "paper": {"HASH_PAPER": 1, "SHADOW_ANGLE_BITS": 5, "ANGLE_BITS": 3, "CELL_BITS": 2},
    "octahedral": {
        "COARSE_BITS": 2,
        "CELL_BITS": 5,
        "FINE_BITS": 2,
        "WIDE_BITS": 12,
        "END_BITS": 8,
    },
    # For `dual`: bundles of 64 gain less by the last bits than sorting by them takes.
    "coarse": {"COARSE_BITS": 2, "CELL_BITS": 4, "FINE_BITS": 2, "WIDE_BITS": 10, "END_BITS": 6},
}
DEFAULT_HASH = "octahedral"
# Of a key; the paper's has the light's number on top.
BITS = {"paper": 32, "octahedral": 24, "coarse": 20}
_CHUNKS_PER_UNIT = 32


def hash_rays(session, rays, slots, name):
    """Keys of the rays in `slots`: close for rays that are likely to meet the same triangles.

    Parameters
    ----------
    session : raystream.device.Session
    rays : raystream.rays.Rays
    slots : Array of shape (n,) uint32
        Ray of each slot, 0xffffffff where there is none.
    name : str
        One of `HASHES`.

    Returns
    -------
    keys : Array of shape (n,) uint32
        0 where there is no ray.
    active : Array of shape (n,) uint8
        Head flags: 1 where the slot holds a ray that is not inactive.
    """
    count = slots.shape[0]
    chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
    kernels = session.kernels("hash.cl", CHUNKS=chunks, **HASHES[name])
    keys, active = session.empty(count, np.uint32), session.empty(count, np.uint8)
    corners, grid = (session.empty((n, 2, 4), np.float32) for n in (2 * chunks, 2))
    light = np.uint32(0xFFFFFFFF if rays.light is None else rays.light)
    stream = rays.org_tnear, rays.dir_tfar

    def launch(kernel, size, *args):
        session.launch(RAY_CREATION, kernels[kernel], size, *args)

    launch("measure_rays", chunks, np.uint64(len(rays)), *stream, corners)
    launch("make_grid", 1, corners, grid)
    launch("hash_rays", chunks, np.uint64(count), slots, *stream, grid, light, keys, active)
    return keys, active
