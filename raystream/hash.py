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
    # For its streams of thousands of rays: one pass of the sort.
    "coarsest": {"COARSE_BITS": 1, "CELL_BITS": 2, "FINE_BITS": 0, "WIDE_BITS": 4, "END_BITS": 2},
}
DEFAULT_HASH = "octahedral"
# Of a key; the paper's has the light's number on top.
BITS = {"paper": 32, "octahedral": 24, "coarse": 20, "coarsest": 8}
_CHUNKS_PER_UNIT = 32
_MEASURED_RUNS = 16  # of every so many runs of rays one is measured where a key need not be exact


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
    keys, active = session.empty(count, np.uint32), session.empty(count, np.uint8)
    grid = _grid(session, rays, name, step=1)
    _launch(session, name, "hash_rays", count, slots, *_arguments(rays, grid), keys, active)
    return keys, active


def hash_all(session, rays, name):
    """Keys of all rays in the order in which they come, quickly.

    The cells divide the box of a sixteenth of the rays: others may lie outside, in the cells at its
    sides.

    Returns
    -------
    Array of shape (n,) uint32
        0 for inactive rays.
    """
    keys = session.empty(len(rays), np.uint32)
    grid = _grid(session, rays, name, _MEASURED_RUNS)
    _launch(session, name, "hash_all", len(rays), *_arguments(rays, grid), keys)
    return keys


def _grid(session, rays, name, step):
    """What a key divides: the boxes of origins and ends of every `step`-th run of sixteen rays."""
    chunks = _chunks(session)
    corners, grid = (session.empty((n, 2, 4), np.float32) for n in (2 * chunks, 2))
    stream = rays.org_tnear, rays.dir_tfar
    _launch(session, name, "measure_rays", len(rays), np.uint32(step), *stream, corners)
    kernel = _kernels(session, name)["make_grid"]
    session.launch(RAY_CREATION, kernel, 1, corners, grid)
    return grid


def _arguments(rays, grid):
    light = np.uint32(0xFFFFFFFF if rays.light is None else rays.light)
    return rays.org_tnear, rays.dir_tfar, grid, light


def _launch(session, name, kernel, count, *args):
    """Run a kernel over the chunks of `count` elements."""
    kernel = _kernels(session, name)[kernel]
    session.launch(RAY_CREATION, kernel, _chunks(session), np.uint64(count), *args)


def _kernels(session, name):
    return session.kernels("hash.cl", CHUNKS=_chunks(session), **HASHES[name])


def _chunks(session):
    return _CHUNKS_PER_UNIT * session.device.max_compute_units
