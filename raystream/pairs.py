"""Streams of (node, triangle) pairs on the device and their reduction (cl/pairs.cl)."""

import dataclasses

import numpy as np
import pyopencl.array as cla

from raystream.reduce import METHODS, SEGMENT_SIZE, Reducer
from raystream.statistics import STREAM_REDUCTION

# Work-items per stream launch: enough to balance the cores, few enough to scan serially.
CHUNKS = 512
PAIR_BYTES = 8
MASK_BYTES = 1  # a bit per child
FUSED = "fused"
REDUCTIONS = (FUSED, *METHODS)
LOADED = 64  # kernels load so many pairs or masks at a time: as many more must be there to read


@dataclasses.dataclass
class PairStream:
    """Pairs (node, triangle) and, on the device, how many of them there are.

    Attributes
    ----------
    pairs : Array of shape (capacity + LOADED, 2) uint32
    length : Array of shape (1,) uint32
        Only the first `length` pairs mean anything.
    """

    pairs: cla.Array
    length: cla.Array

    @classmethod
    def empty(cls, session, capacity):
        """An uninitialised stream of room for `capacity` pairs."""
        pairs = session.empty((capacity + LOADED, 2), np.uint32)
        return cls(pairs, session.empty(1, np.uint32))

    @property
    def capacity(self):
        """Pairs that it can hold."""
        return self.pairs.shape[0] - LOADED


class Reduction:
    """Turns the survivor counts and masks of one pass into the next stream.

    Attributes
    ----------
    chunk_tests, chunk_hits : Array of shape (CHUNKS,) uint64
        What the producer counted per chunk.
    offsets : Array of shape (CHUNKS,) uint32
        Survivors before each chunk.
    overflow : Array of shape (1,) uint64
        Survivors of a pass that did not fit, 0 where all fitted.
    """

    def __init__(self, session, arity):
        self.session, self.arity = session, arity
        self._kernels = session.kernels("pairs.cl", ARITY=arity, CHUNKS=CHUNKS)
        self.chunk_tests = session.empty(CHUNKS, np.uint64)
        self.chunk_hits = session.empty(CHUNKS, np.uint64)
        self.offsets = session.empty(CHUNKS, np.uint32)
        self.overflow = session.empty(1, np.uint64)
        session.fill(STREAM_REDUCTION, self.overflow, 0)

    def scan(self, source, target, counts, row, tasks=0):
        """Offsets of the chunks' survivors, and the length of `target`; see cl/pairs.cl.

        Parameters
        ----------
        source : PairStream or None
            The pass's input, None where it was a loop over `tasks` pairs that were never written.
        target : PairStream
        counts : Array of shape (rows, 3) uint64
            Row `row` is the level's tests, hits and input length; tests and hits are added to.
        row : int
        """
        self.session.launch(
            STREAM_REDUCTION,
            self._kernels["scan_chunks"],
            1,
            np.uint32(target.capacity),
            np.uint64(tasks),
            target.length if source is None else source.length,
            self.chunk_tests,
            self.chunk_hits,
            self.offsets,
            target.length,
            self.overflow,
            counts,
            np.uint32(row),
        )

    def scatter(self, source, masks, target):
        """Write the surviving children of `source`'s pairs to their places in `target`."""
        self.session.launch(
            STREAM_REDUCTION,
            self._kernels["scatter_children"],
            CHUNKS,
            source.length,
            source.pairs,
            masks,
            self.offsets,
            target.length,
            target.pairs,
        )


class SeparateReduction(Reduction):
    """The paper's form: every child is written out with a flag, then the stream is reduced.

    It shows what a stream reduction of its own costs. Unlike the fused form it reads the length of
    the stream back at every level.
    """

    def __init__(self, session, arity, method, capacity):
        super().__init__(session, arity)
        self._method = method
        self._reducer = Reducer(session, PAIR_BYTES)
        self._total = session.empty(1, np.uint32)
        # All of one size, whatever a level needs: the pool has them again at the next call.
        self._children, self._scratch = (
            session.empty((capacity * arity, 2), np.uint32) for _ in range(2)
        )
        self._keep = session.empty(capacity * arity, np.uint8)

    def scatter(self, source, masks, target):
        """As `Reduction.scatter`."""
        if int(target.length.get()[0]) == 0:
            return
        count = int(source.length.get()[0]) * self.arity
        self.session.launch(
            STREAM_REDUCTION,
            self._kernels["expand_children"],
            CHUNKS,
            source.length,
            source.pairs,
            masks,
            self._children,
            self._keep,
        )
        arrays = self._children, self._keep, target.pairs, self._total
        self._reducer.reduce(self._method, count, *arrays, SEGMENT_SIZE, self._scratch)


def make_reduction(session, arity, name, capacity):
    """The reduction of that name, one of `REDUCTIONS`, for streams of up to `capacity` pairs."""
    if name == FUSED:
        return Reduction(session, arity)
    return SeparateReduction(session, arity, name, capacity)


def bytes_per_pair(arity, reduction):
    """What a pair of capacity costs: a place in two streams and a mask; its children, apart."""
    fused = 2 * PAIR_BYTES + MASK_BYTES
    if reduction == FUSED:
        return fused
    return fused + arity * (2 * PAIR_BYTES + 1)  # children, their flags, and what reduces them
