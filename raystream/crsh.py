"""Method `crsh`: the coherent ray-space hierarchy of Reis, Costa and Pereira (2017).

The ray-space hierarchy (`rsh`) over rays that are hashed and sorted first, so that nodes hold rays
that go the same way from the same place; and whole parts of the scene are culled by their bounding
spheres before their triangles are tested against the top level.

The paper's algorithm: ``hash="paper", bound="paper", arity=8, levels=2``. Beyond it, and the
default: hashes that keep neighbours together, tighter nodes that know where their rays end, and
clusters of neighbouring triangles, made anew every frame, in the place of whole meshes. Defaults:
those of the fewest tests over the scenes of tests/bench/bench_counts.py.
"""

from raystream.checks import check_choice, check_count
from raystream.hash import DEFAULT_HASH
from raystream.objects import Objects
from raystream.order import hashed_slots
from raystream.pairs import FUSED
from raystream.rsh import RayspaceTracer

_CLUSTER_SIZE = 32
_CLUSTER_STEP = 16  # clusters are whole blocks of spheres: cl/objects.cl


class CoherentTracer(RayspaceTracer):
    """Coherent ray-space hierarchy over one geometry.

    Parameters
    ----------
    session, geometry, memory_limit, reduction
        As for `raystream.rsh.RayspaceTracer`.
    arity : {4, 8}
        Children per node; 8 in the paper.
    levels : int
        Node levels above the rays; 2 in the paper.
    hash : {"paper", "octahedral"} or None
        What the rays are sorted by (cl/hash.cl); None leaves them in the order of the screen.
    bound : {"tight", "sphere", "paper"}
        As for `raystream.rsh.RayspaceTracer`.
    cull_meshes : bool
        Test the top level's nodes against bounding spheres of parts of the scene first.
    clusters : int, None or "auto"
        These parts: clusters of so many triangles, a multiple of 16, or whole meshes where None, as
        in the paper. "auto": None with the bounds of the paper, else 32.

    Raises
    ------
    ValueError
        An option that there is not.
    """

    def __init__(
        self,
        session,
        geometry,
        memory_limit,
        arity=4,
        levels=4,
        reduction=FUSED,
        hash=DEFAULT_HASH,
        bound="tight",
        cull_meshes=True,
        clusters="auto",
    ):
        check_count("levels", levels)
        super().__init__(session, geometry, memory_limit, arity, levels, reduction, bound)
        check_choice("hash", hash, ("paper", DEFAULT_HASH, None))
        check_choice("cull_meshes", cull_meshes, (True, False))
        if clusters == "auto":
            clusters = None if bound == "paper" else _CLUSTER_SIZE
        if clusters is not None and check_count("clusters", clusters) % _CLUSTER_STEP != 0:
            raise ValueError(f"clusters: need a multiple of {_CLUSTER_STEP}, got {clusters}")
        self._hash, self._culling = hash, None
        if cull_meshes and clusters is None:
            self._culling = Objects.meshes(session, geometry)
        elif cull_meshes:
            self._culling = Objects.clusters(session, geometry, clusters)
        self._version = geometry.version

    def _slots(self, rays):
        slots = super()._slots(rays)
        if self._hash is None:
            return slots
        return hashed_slots(self.session, rays, slots, self._hash)

    def _objects(self):
        if self._culling is not None and self._version != self.geometry.version:
            self._culling.update()
            self._version = self.geometry.version
        return self._culling
