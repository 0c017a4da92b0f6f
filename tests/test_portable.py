"""The portable path of cl/simd.h gives the same results, bit for bit, as the x86 built-ins."""

import numpy as np
import pytest
from soup import exact_tracer, random_rays, triangle_soup

import raystream as rs
from raystream import device, program


@pytest.mark.parametrize("method", rs.methods())
def test_hits_and_counts_are_the_same_on_both_paths(method, request, rng):
    scene = triangle_soup(rng, 700, size=0.3)
    rays = random_rays(rng, 1009)
    first = exact_tracer(scene, method)
    expected, counts = first.intersect(*rays), first.statistics
    request.getfixturevalue("portable")
    second = exact_tracer(scene, method)
    hits = second.intersect(*rays)
    for field in ("t", "prim_id", "geom_id", "u", "v"):
        np.testing.assert_array_equal(getattr(hits, field), getattr(expected, field), field)
    assert second.statistics.levels == counts.levels
    assert second.statistics.final_hits == counts.final_hits


SOURCE = """
#include "common.h"
kernel void probe(global const int16 *truth, global const uchar *bytes, global const uint16 *words,
                  global const float16 *floats, global const float4 *quads, global uint *masks,
                  global ulong *tested, global uint16 *even_odd, global float16 *sums)
{
    masks[0] = MASK16(truth[0]);
    masks[1] = COUNT16(MASK16(truth[0]));
    masks[2] = COUNT64(0x8000000000000001ul);
    masks[3] = LOWEST(0x50u);
    for (uint bit = 0; bit < 8; bit++)
        tested[bit] = TEST64(bytes + 3, bit);
    even_odd[0] = EVEN_LANES(words[0], words[1]);
    even_odd[1] = ODD_LANES(words[0], words[1]);
    sums[0] = FMA16(floats[0], floats[1], floats[2]);
    sums[1].s0 = FMA(floats[0].s0, floats[1].s0, floats[2].s0);
    float4 s[16] __attribute__((aligned(64)));
    for (uint k = 0; k < 16; k++)
        s[k] = quads[k];
    TRANSPOSE16(s, sums[2], sums[3], sums[4], sums[5]);
}
"""


def test_every_operation_does_what_its_comment_says(path, tmp_path, monkeypatch, rng):
    folder = program.source_folder()
    for name in ("common.h", "simd.h"):
        (tmp_path / name).write_text((folder / name).read_text())
    (tmp_path / "probe.cl").write_text(SOURCE)
    session = device.session()
    monkeypatch.setattr(program, "source_folder", lambda: tmp_path)
    program.expand.cache_clear()
    kernel = session.kernels("probe.cl")["probe"]
    program.expand.cache_clear()

    truth = -rng.integers(0, 2, 16).astype(np.int32)
    data = rng.integers(0, 256, 80).astype(np.uint8)
    words = rng.integers(0, 2**32, (2, 16)).astype(np.uint32)
    floats = rng.normal(size=(3, 16)).astype(np.float32)
    quads = rng.normal(size=(16, 4)).astype(np.float32)
    masks, tested = session.empty(4, np.uint32), session.empty(8, np.uint64)
    even_odd, sums = session.empty((2, 16), np.uint32), session.empty((6, 16), np.float32)
    inputs = [session.upload("test", a) for a in (truth, data, words, floats, quads)]
    session.launch("test", kernel, 1, *inputs, masks, tested, even_odd, sums)
    session.finish()

    bits = sum(1 << i for i in range(16) if truth[i])
    assert masks.get().tolist() == [bits, bits.bit_count(), 2, 4]
    set_bits = np.unpackbits(data[3:67, None], axis=1, bitorder="little").T
    packed = np.ascontiguousarray(np.packbits(set_bits, axis=1, bitorder="little"))
    expected = packed.view(np.uint64)[:, 0]
    np.testing.assert_array_equal(tested.get(), expected)
    flat = words.ravel()
    np.testing.assert_array_equal(even_odd.get(), [flat[::2], flat[1::2]])
    exact = floats.astype(np.float64)
    rounded = (exact[0] * exact[1] + exact[2]).astype(np.float32)  # the product is exact in float64
    np.testing.assert_allclose(sums.get()[0], rounded, rtol=1.2e-7)
    assert sums.get()[1, 0] == sums.get()[0, 0]
    np.testing.assert_array_equal(sums.get()[2:], quads.T)
