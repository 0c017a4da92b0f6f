"""Rays in the order of their hash keys, on CPU devices (cl/compress.cl).

The ray-order stages of the coherent ray-space hierarchy (Reis et al. 2017, sections 3.3.2 to
3.3.5): neighbouring rays of one key travel as one chunk through the sort. All arrays are as long as
the stream was before trimming; how much of them is in use stays on the device.
"""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream import scan
from raystream import sort as radix
from raystream.reduce import Reducer
from raystream.statistics import COMPRESSION, DECOMPRESSION, SORTING

_CHUNKS_PER_UNIT = 32


@dataclasses.dataclass
class Chunks:
    """Runs of rays of one key; the first `length` entries of each array are chunks.

    Attributes
    ----------
    keys : Array of shape (n,) uint32
    bases : Array of shape (n,) uint32
        Place of a chunk's first ray among the trimmed ones.
    sizes : Array of shape (n,) uint32
        Number of rays.
    length : Array of shape (1,) uint32
    """

    keys: cla.Array
    bases: cla.Array
    sizes: cla.Array
    length: cla.Array


def coherent_slots(session, keys, rays, active, bits):
    """The active rays in ascending order of their keys.

    Parameters
    ----------
    session : raystream.device.Session
    keys : Array of shape (n,) uint32
        Hash of each slot's ray.
    rays : Array of shape (n,) uint32
        Ray in each slot.
    active : Array of shape (n,) uint8
        There is a ray in the slot where it is not 0.
    bits : int
        Only the lowest `bits` bits of the keys count.

    Returns
    -------
    slots : Array of shape (n,) uint32
        The active rays, those of equal keys in the order they had, then 0xffffffff.
    num_chunks : Array of shape (1,) uint32
        How many chunks were sorted.
    """
    keys, rays, count = trim(session, keys, rays, active)
    chunks = compress(session, keys, count)
    order = sort(session, chunks, bits)
    return decompress(session, chunks, order, rays, count), chunks.length


def trim(session, keys, rays, active):
    """The keys and rays of the active slots, moved to the left (figure 4).

    Parameters
    ----------
    session, keys, rays, active
        As for `coherent_slots`.

    Returns
    -------
    keys, rays : Array of shape (n,) uint32
        The first `count` are in use.
    count : Array of shape (1,) uint32
    """
    return _keep(session, active, keys, rays)


def compress(session, keys, count):
    """`Chunks` of neighbouring rays whose keys are the same (figure 5).

    Parameters
    ----------
    session : raystream.device.Session
    keys : Array of shape (n,) uint32
    count : Array of shape (1,) uint32
        Number of keys in use.
    """
    n = keys.shape[0]
    heads, positions, sizes = (session.empty(n, t) for t in (np.uint8, np.uint32, np.uint32))
    _launch(session, COMPRESSION, "flag_heads", np.uint64(n), count, keys, heads, positions)
    chunk_keys, bases, length = _keep(session, heads, keys, positions)
    _launch(session, COMPRESSION, "size_chunks", length, count, bases, sizes)
    return Chunks(chunk_keys, bases, sizes, length)


def sort(session, chunks, bits):
    """The chunks in ascending order of the lowest `bits` bits of their keys, stable.

    Returns
    -------
    Array of shape (n,) uint32
        Number of each chunk; the first ``chunks.length`` are in use.
    """
    numbers = session.empty(chunks.keys.shape, np.uint32)
    _launch(session, SORTING, "number_chunks", chunks.length, numbers)
    with session.clock.under(SORTING):
        return radix.sort_by_key(
            session, chunks.keys, numbers, bits, chunks.length, keep_keys=False
        )[1]


def decompress(session, chunks, order, rays, count):
    """The rays of the chunks, chunk by chunk in the order given (figure 6).

    Parameters
    ----------
    session : raystream.device.Session
    chunks : Chunks
    order : Array of shape (n,) uint32
        From `sort`.
    rays : Array of shape (n,) uint32
        Trimmed, `count` in use.
    count : Array of shape (1,) uint32

    Returns
    -------
    Array of shape (n,) uint32
        0xffffffff behind the last ray.
    """
    n = np.uint64(rays.shape[0])
    skeleton, bases, starts, slots = (session.empty(rays.shape, np.uint32) for _ in range(4))
    arrays = order, chunks.sizes, chunks.bases, skeleton, bases
    _launch(session, DECOMPRESSION, "write_skeleton", n, chunks.length, *arrays)
    with session.clock.under(DECOMPRESSION):
        scan.scan(session, skeleton, starts)
    _launch(session, DECOMPRESSION, "fill_slots", n, count, bases, starts, rays, slots)
    return slots


def _keep(session, keep, *values):
    """What is kept of each of `values`, moved to the left, and how many that are."""
    n = keep.shape[0]
    kept, total = [session.empty(n, np.uint32) for _ in values], session.empty(1, np.uint32)
    with session.clock.under(COMPRESSION):
        Reducer(session, 4).scan(n, keep, total, *zip(values, kept, strict=True))
    return *kept, total


def _launch(session, stage, kernel, *args):
    chunks = _CHUNKS_PER_UNIT * session.device.max_compute_units
    kernels = session.kernels("compress.cl", CHUNKS=chunks)
    session.launch(stage, kernels[kernel], chunks, *args)
