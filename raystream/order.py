"""The order of rays in the leaves of a hierarchy: in tiles (cl/order.cl), or by their hashes."""

import functools

import numpy as np

from raystream import compress, hash
from raystream.sort import sort_by_key
from raystream.statistics import RAY_CREATION, SORTING

_INVALID = np.uint32(0xFFFFFFFF)
_TILE = 8
_DIGIT_BITS = 10  # two passes over coarse hashes
_LEAST_CHUNK, _CHUNKS_PER_UNIT = 4096, 16  # eight rows of some 500 rays


def screen_slots(width, height):
    """The rays of a screen in the order of the hierarchy's leaves.

    Pixels follow the Z-order curve within tiles of 8 x 8, and the tiles that the screen has
    follow it, too: every 4^k consecutive leaves of a tile are a square, 8 leaves are 4 x 2. Where
    the side is a power of two this is the quad-tree of the paper; elsewhere only the tiles at the
    right and lower edge carry null leaves.

    Returns
    -------
    ndarray of shape (m,) uint32
        Ray (pixel) of each leaf, 0xffffffff for a null leaf.
    """
    return _screen_slots(width, height).copy()


@functools.lru_cache(maxsize=8)
def _screen_slots(width, height):
    columns, rows = -(-width // _TILE), -(-height // _TILE)
    tile_y, tile_x = np.divmod(np.arange(columns * rows, dtype=np.uint64), np.uint64(columns))
    order = np.argsort(_interleave(tile_x, tile_y), kind="stable")
    within = np.arange(_TILE * _TILE, dtype=np.uint64)
    x = tile_x[order, None] * _TILE + _deinterleave(within)
    y = tile_y[order, None] * _TILE + _deinterleave(within >> np.uint64(1))
    pixels = np.where((x < width) & (y < height), y * width + x, _INVALID)
    return pixels.ravel().astype(np.uint32)


def _interleave(x, y):
    """Bits of x at the even places, bits of y at the odd places."""
    return sum(
        ((x >> np.uint64(b) & np.uint64(1)) << np.uint64(2 * b))
        | ((y >> np.uint64(b) & np.uint64(1)) << np.uint64(2 * b + 1))
        for b in range(24)
    )


def _deinterleave(code):
    """The number made of the even bits of `code`."""
    return sum((code >> np.uint64(2 * b) & np.uint64(1)) << np.uint64(b) for b in range(3))


def leaf_slots(session, rays):
    """The rays in the order in which they come, pixels in that of `screen_slots`.

    Returns
    -------
    Array of shape (n,) uint32
        Kept by the session: uploaded once per size.
    """
    kept = session.cache.setdefault("leaf_slots", {})
    kind, size = ("rays", len(rays)) if rays.size is None else ("screen", rays.size)
    if kind not in kept or kept[kind][0] != size:  # one of each kind: sizes change rarely
        host = np.arange(size, dtype=np.uint32) if kind == "rays" else _screen_slots(*size)
        kept[kind] = size, session.upload(RAY_CREATION, host)
    return kept[kind][1]


def hashed_slots(session, rays, slots, name):
    """The active rays of `slots` sorted by their hashes (Reis et al. 2017, sections 3.3.2 to 5).

    Parameters
    ----------
    session : raystream.device.Session
    rays : raystream.rays.Rays
    slots : Array of shape (n,) uint32
        The order that rays of equal hashes keep.
    name : str
        One of `hash.HASHES`.

    Returns
    -------
    Array of shape (n,) uint32
        Behind the active rays 0xffffffff.
    """
    keys, active = hash.hash_rays(session, rays, slots, name)
    return compress.coherent_slots(session, keys, slots, active, hash.BITS[name])[0]


def sorted_rays(session, rays, name):
    """All rays, in the order of their hashes; inactive ones, too.

    Where neighbours seldom have equal hashes, compressing runs of them, as `hashed_slots` does,
    costs more than it saves.

    Parameters
    ----------
    session : raystream.device.Session
    rays : raystream.rays.Rays
        Not those of a screen: tiles of it are as good as any order.
    name : str
        One of `hash.HASHES`.

    Returns
    -------
    Array of shape (n,) uint32
    """
    keys, given = hash.hash_all(session, rays, name), leaf_slots(session, rays)
    with session.clock.under(SORTING):
        return sort_by_key(
            session, keys, given, hash.BITS[name], digit_bits=_DIGIT_BITS, keep_keys=False
        )[1]


def tiled_slots(session, rays):
    """Rays from one point to what a picture shows, row by row, in tiles; some pixels may have none.

    Parameters
    ----------
    session : raystream.device.Session
    rays : raystream.rays.Rays
        At least one.

    Returns
    -------
    Array of shape (n,) uint32
        All rays; in the order given where they are not in rows.
    """
    most = _CHUNKS_PER_UNIT * session.device.max_compute_units
    chunks = max(1, min(most, len(rays) // _LEAST_CHUNK))
    slots, count = session.empty(len(rays), np.uint32), np.uint32(len(rays))
    kernel = session.kernels("order.cl")["tile_rows"]
    session.launch(RAY_CREATION, kernel, chunks, count, rays.dir_tfar, slots)
    return slots
