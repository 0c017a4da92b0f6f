"""What all tracers share of hits: their fields, and the numbers of meshes and faces."""

import numpy as np
import pytest

import raystream as rs
from raystream import device, intersect
from raystream.geometry import Geometry

SIZES = [0, 1, 15, 16, 17, 1009, 20_011]


@pytest.mark.parametrize("count", SIZES)
def test_hits_of_records(count, path, rng):
    session = device.session()
    records = rng.random((count, 4), np.float32)
    records[:, 3] = np.arange(count, dtype=np.uint32)[::-1].view(np.float32)
    records[::3, 3] = np.uint32(0xFFFFFFFF).view(np.float32)
    hits = intersect.HitStream.unpack(session, session.upload("test", records))
    for k, field in enumerate((hits.t, hits.u, hits.v)):
        np.testing.assert_array_equal(field.get(), records[:, k])
    np.testing.assert_array_equal(hits.triangle.get(), records[:, 3].view(np.uint32))


@pytest.mark.parametrize("count", SIZES)
@pytest.mark.parametrize("faces", [[7], [5, 1, 9]])
def test_numbers_of_meshes_and_faces(faces, count, path, rng):
    session = device.session()
    meshes = [rs.Mesh(np.eye(3, dtype=np.float32), [[0, 1, 2]] * n) for n in faces]
    geometry = Geometry(session, rs.Scene(meshes))
    triangle = rng.integers(0, sum(faces), count).astype(np.uint32)
    triangle[rng.random(count) < 0.3] = 0xFFFFFFFF
    hits = intersect.HitStream.empty(session, count)
    hits.triangle = session.upload("test", triangle)
    geom_id, prim_id = intersect.split_ids(session, hits, geometry)
    meshes_of = np.repeat(np.arange(len(faces)), faces)
    faces_of = np.concatenate([np.arange(n) for n in faces])
    missed = triangle == 0xFFFFFFFF
    found = np.where(missed, 0, triangle)
    np.testing.assert_array_equal(geom_id.get(), np.where(missed, -1, meshes_of[found]))
    np.testing.assert_array_equal(prim_id.get(), np.where(missed, -1, faces_of[found]))
