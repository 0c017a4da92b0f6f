"""Where rays slip through the surface that `ldc` has samples of, as planes or as published.

A triangle is sampled in the direction that its normal is closest to. Around an edge where that
direction turns, neither of two triangles has a sample in some texels that both touch.
"""

import dataclasses

import numpy as np
from ldc_pictures import APART
from raystream.baselines import EmbreeTracer

import raystream as rs


@dataclasses.dataclass
class Gaps:
    """Rays that slipped through the triangle that they hit.

    Attributes
    ----------
    hits, slipped : int
        Rays that hit by Embree; those that by `ldc` miss or hit later by over `APART`.
    near_edge, at_turn : float
        Shares of those that slipped: within half a texel of the triangle's edge; where a triangle
        that shares a vertex is sampled in another direction.
    hits_at_turn : float
        Share of all hits where that is so.
    """

    hits: int
    slipped: int
    near_edge: float
    at_turn: float
    hits_at_turn: float


def find_gaps(scene, origins, directions, resolution=512, **options):
    """Trace rays by `ldc` with these options and by Embree; returns `Gaps`."""
    ours = rs.Tracer(scene, "ldc", resolution=resolution, **options).intersect(origins, directions)
    theirs = EmbreeTracer.from_scene(scene).intersect(origins, directions)
    hit = theirs.prim_id >= 0
    late = ours.t[hit] - theirs.t[hit]  # infinite for a miss
    slipped = late * np.linalg.norm(directions[hit], axis=1) > APART * scene.diagonal
    triangle = scene.first_prims[theirs.geom_id[hit]] + theirs.prim_id[hit]
    points = (origins + theirs.t[:, None] * directions)[hit][slipped]
    texel = np.ptp(scene.bounds, axis=0).max() / resolution
    corners = scene.vertices[scene.faces].astype(np.float64)
    near = edge_distances(corners[triangle[slipped]], points) < texel / 2
    turns = at_turn(corners)[triangle]
    return Gaps(len(triangle), len(points), near.mean(), turns[slipped].mean(), turns.mean())


def edge_distances(corners, points):
    """Distance of a point from the nearest edge of a triangle, of each pair."""
    along = np.roll(corners, -1, axis=1) - corners
    offset = points[:, None] - corners
    part = np.einsum("nek,nek->ne", offset, along) / np.einsum("nek,nek->ne", along, along)
    away = offset - np.clip(part, 0, 1)[..., None] * along
    return np.linalg.norm(away, axis=2).min(axis=1)


def at_turn(corners):
    """Whether a triangle with a vertex at the same place is sampled in another direction."""
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    direction = np.abs(normals).argmax(axis=1)
    places, place = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    place = place.reshape(-1, 3)
    directions = np.zeros((len(places), 3), bool)
    directions[place, direction[:, None]] = True
    return (np.count_nonzero(directions, axis=1) > 1)[place].any(axis=1)
