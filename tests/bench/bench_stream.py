"""Stream primitives beside what else a PyOpenCL user could install, all in one run.

    python tests/bench/bench_stream.py [-o FOLDER] [--quick]

Prints tables of GB/s (bytes of values and flags read and survivors written; for the plain copy
kernel bytes read and written) and of pairs/s; with -o writes them as stream.png. `make bench` runs
the same operations under pytest-benchmark.
"""

import argparse
import pathlib
import statistics
import time
import warnings

import numpy as np
import pyopencl as cl
import pyopencl.array as cla
import pytest
from tqdm import tqdm

from raystream import device, scan, sort
from raystream.reduce import METHODS, SEGMENT_SIZE, Reducer

PAPER_SEGMENT = 64
SHARES = (0.1, 0.25, 0.5)
COPY = """
kernel void copy_words(const ulong n, global const uint16 *from, global uint16 *to)
{
    const ulong chunks = get_global_size(0), chunk = get_global_id(0);
    for (ulong i = chunk * n / chunks, end = (chunk + 1) * n / chunks; i < end; i++)
        to[i] = from[i];
}
"""


class Bench:
    """Arrays and operations of one length; every operation waits for its end."""

    def __init__(self, count):
        self.count = count
        self.session = device.session()
        self.queue = self.session.queue
        self.rng = np.random.default_rng(16)
        self.copy_arrays = [self.filled((count, 2), np.uint32) for _ in range(2)]
        self.copy_kernel = cl.Kernel(cl.Program(self.session.context, COPY).build(), "copy_words")

    def median(self, run, runs=7):
        """Median seconds of `run` after one warm-up."""
        run()
        seconds = []
        for _ in range(runs):
            self.queue.finish()
            start = time.perf_counter()
            run()
            self.queue.finish()
            seconds.append(time.perf_counter() - start)
            self.session.clock.forget()
        return statistics.median(seconds)

    def filled(self, shape, dtype):
        array = self.session.empty(shape, dtype)
        self.session.fill("bench", array, 1)  # touch the pages
        return array

    def copy_speed(self):
        """Bytes per second, read and written, of a plain copy of `count` pairs."""
        source, target = self.copy_arrays
        args = np.uint64(source.nbytes // 64), source.data, target.data
        seconds = self.median(lambda: self.copy_kernel(self.queue, (64,), (1,), *args), 5)
        return 2 * source.nbytes / seconds

    def beside_copy(self, figures):
        """Each (name, figure) with its ratio to a copy measured just before: machines drift."""
        figures = iter(figures)
        while True:
            copy = self.copy_speed()
            following = next(figures, None)
            if following is None:
                return
            yield *following, following[1] / copy


def reductions(bench, share):
    """(name, GB/s) of reducing `count` pairs of 8 bytes, of which `share` survives."""
    values, out = (bench.filled((bench.count, 2), np.uint32) for _ in range(2))
    keep = (bench.rng.random(bench.count) < share).astype(np.uint8)
    flags, total = bench.session.upload("bench", keep), bench.session.empty(1, np.uint32)
    moved = values.nbytes + keep.nbytes + 8 * int(keep.sum())
    reducer = Reducer(bench.session, 8)

    def device_run(method, size):
        return lambda: reducer.reduce(method, bench.count, values, flags, out, total, size)

    for method in METHODS:
        runs = 3 if method == "horn" else 7
        yield method, moved / bench.median(device_run(method, SEGMENT_SIZE), runs)
    name = f"segmented, s = {PAPER_SEGMENT}"
    yield name, moved / bench.median(device_run("segmented", PAPER_SEGMENT))
    lengths = bench.session.empty(-(-bench.count // SEGMENT_SIZE), np.uint32)
    arrays = values, flags, out, lengths
    in_place = bench.median(lambda: reducer.segments(bench.count, *arrays, SEGMENT_SIZE))
    yield "segments left in place", moved / in_place
    host = np.arange(bench.count, dtype=np.uint64)
    yield "numpy boolean indexing", moved / bench.median(lambda: host[keep.view(bool)], 3)
    yield "numba, parallel", moved / bench.median(numba_run(host, keep), 3)
    yield from copy_if(bench, keep, moved)


def numba_run(values, keep):
    import numba

    @numba.njit(parallel=True)
    def compact(values, keep, out, offsets):
        chunks = len(offsets) - 1
        size = -(-len(values) // chunks)
        for c in numba.prange(chunks):
            offsets[c + 1] = keep[c * size : (c + 1) * size].sum()
        for c in range(chunks):
            offsets[c + 1] += offsets[c]
        for c in numba.prange(chunks):
            place = offsets[c]
            for i in range(c * size, min((c + 1) * size, len(values))):
                if keep[i]:
                    out[place] = values[i]
                    place += 1

    out, offsets = np.empty_like(values), np.zeros(65, np.int64)
    return lambda: compact(values, keep, out, offsets)


def copy_if(bench, keep, moved):
    """pyopencl's own, on 32-bit elements (half the bytes of a pair), a sixteenth of the length."""
    from pyopencl.algorithm import copy_if as run_copy_if

    count = max(1, bench.count // 16)
    values = cla.to_device(bench.queue, keep[:count].astype(np.uint32))
    seconds = bench.median(lambda: run_copy_if(values, "ary[i] != 0")[2].wait(), 3)
    yield "pyopencl copy_if", (4 * count + 4 * int(keep[:count].sum())) / seconds


def scans(bench):
    """(name, bytes per second) of an exclusive scan of uint32."""
    values, out = (bench.filled(bench.count, np.uint32) for _ in range(2))
    moved = 2 * values.nbytes
    yield "exclusive_scan", moved / bench.median(lambda: scan.scan(bench.session, values, out))
    host = values.get()
    yield "np.cumsum", moved / bench.median(lambda: np.cumsum(host, dtype=np.uint32), 3)


def sorts(bench):
    """(name, pairs per second) of sorting 32-bit keys with a 32-bit value each."""
    count = bench.count
    host = bench.rng.integers(0, 2**32, count, dtype=np.uint32)
    keys = bench.session.upload("bench", host)
    values = bench.session.upload("bench", np.arange(count, dtype=np.uint32))
    run = lambda: sort.sort_by_key(bench.session, keys, values, 32)  # noqa: E731
    yield "sort_by_key", count / bench.median(run)
    yield "np.argsort, stable", count / bench.median(lambda: np.argsort(host, kind="stable"), 3)
    yield "np.sort (keys alone)", count / bench.median(lambda: np.sort(host), 3)
    yield "pyopencl RadixSort", count / bench.median(radix_sort_run(bench, keys, values), 1)


def radix_sort_run(bench, keys, values):
    from pyopencl.algorithm import RadixSort
    from pyopencl.tools import VectorArg

    arguments = [VectorArg(np.uint32, name, with_offset=True) for name in ("keys", "values")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations inside pyopencl
        sorter = RadixSort(
            bench.session.context, arguments, key_expr="keys[i]", sort_arg_names=["keys", "values"]
        )
    return lambda: sorter(keys, values, key_bits=32, queue=bench.queue)[1].wait()


# --- under pytest-benchmark ---


@pytest.fixture(scope="module")
def bench():
    return Bench(1 << 24)


@pytest.mark.parametrize("share", SHARES)
@pytest.mark.parametrize("method", METHODS)
def test_reduce(benchmark, bench, method, share):
    values, out = (bench.filled((bench.count, 2), np.uint32) for _ in range(2))
    flags = bench.session.upload("b", (bench.rng.random(bench.count) < share).astype(np.uint8))
    total, reducer = bench.session.empty(1, np.uint32), Reducer(bench.session, 8)

    def run():
        reducer.reduce(method, bench.count, values, flags, out, total, SEGMENT_SIZE)
        bench.session.finish()

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)


def test_scan(benchmark, bench):
    values, out = (bench.filled(bench.count, np.uint32) for _ in range(2))

    def run():
        scan.scan(bench.session, values, out)
        bench.session.finish()

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)


@pytest.mark.parametrize("count", [1 << 18, 1 << 20, 1 << 22])
def test_sort(benchmark, bench, count):
    keys = bench.session.upload("b", bench.rng.integers(0, 2**32, count, dtype=np.uint32))

    def run():
        sort.sort_by_key(bench.session, keys, keys, 32)
        bench.session.finish()

    benchmark.pedantic(run, rounds=5, warmup_rounds=1)


# --- tables and plot ---


def measure(lengths):
    """Rows (operation, length, method, figure, its ratio to the copy)."""
    rows = []
    for count in tqdm(lengths, disable=None):
        bench = Bench(count)
        rows.append(("copy", count, "plain copy kernel", bench.copy_speed(), 1.0))
        for share in SHARES:
            for figures in bench.beside_copy(reductions(bench, share)):
                rows.append((f"reduce, {share:.0%} survive", count, *figures))
        rows += [("scan", count, *figures) for figures in bench.beside_copy(scans(bench))]
        rows += [("sort", count, *figures) for figures in bench.beside_copy(sorts(bench))]
    return rows


def show(rows):
    for operation, count, name, figure, share in rows:
        if operation == "sort":
            speed = f"{figure / 1e6:6.0f} M/s, {1e3 * share:.1f} M/s for each GB/s of copy"
        else:
            speed = f"{figure / 1e9:6.2f} GB/s {share:6.0%} of copy"
        print(f"{operation:22} {count:>9} {name:26} {speed}")


def plot(rows, path):
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    operations = list(dict.fromkeys(row[0] for row in rows if row[0] != "copy"))
    figure, axes = pyplot.subplots(1, len(operations), figsize=(5 * len(operations), 5))
    for axis, operation in zip(axes, operations, strict=True):
        mine = [row for row in rows if row[0] == operation]
        for name in dict.fromkeys(row[2] for row in mine):
            points = [(row[1], row[3]) for row in mine if row[2] == name]
            axis.plot(*zip(*points, strict=True), marker="o", label=name)
        if operation != "sort":
            copies = [(row[1], row[3]) for row in rows if row[0] == "copy"]
            axis.plot(*zip(*copies, strict=True), "k--", label="plain copy kernel")
        axis.set(xscale="log", yscale="log", xlabel="elements", title=operation)
        axis.set_ylabel("pairs per second" if operation == "sort" else "bytes per second")
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=pathlib.Path)
    parser.add_argument("--quick", action="store_true", help="lengths up to 1 M only")
    options = parser.parse_args()
    rows = measure([1 << 18, 1 << 20] if options.quick else [1 << 18, 1 << 20, 1 << 22, 1 << 24])
    show(rows)
    if options.output:
        options.output.mkdir(parents=True, exist_ok=True)
        plot(rows, options.output / "stream.png")


if __name__ == "__main__":
    main()
