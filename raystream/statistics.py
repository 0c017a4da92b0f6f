"""What a call counted and how long its stages took (the tables of the papers)."""

import contextlib
import dataclasses
import itertools

# Stage names, as in the papers.
GEOMETRY = "geometry"
RASTERISATION = "rasterisation"
RAY_CREATION = "ray creation"
COMPRESSION = "compression"
SORTING = "sorting"
DECOMPRESSION = "decompression"
HIERARCHY_CREATION = "hierarchy creation"
TRAVERSAL = "traversal"
STREAM_REDUCTION = "stream reduction"
FINAL_INTERSECTION = "final intersection"
SHADING = "shading"


_SUMMED = (
    "mesh_tests", "final_tests", "final_hits", "rays", "batches", "packets", "simd_rays"
)  # fmt: skip


@dataclasses.dataclass
class Statistics:
    """Counts and stage times of one call; counts are exact and do not change from run to run.

    Attributes
    ----------
    levels : list of dict
        Top level first: ``nodes`` (without null nodes), ``tests`` (node, triangle), ``hits`` and
        ``misses`` of these tests.
    mesh_tests : int
        Tests of top-level nodes against the bounding spheres of meshes or clusters (`crsh`).
    final_tests, final_hits : int
        Ray-triangle tests and how many of them hit within the ray's segment.
    rays, triangles : int
        Rays that were traced (inactive ones are not), triangles of the scene.
    peak_stream_bytes : int
        The largest sum of candidate streams held at one time.
    batches : int
        Number of triangle batches the work was cut into to stay within `memory_limit`.
    structure_bytes : int
        What the method has built of the scene, to be kept for a frame (`ldc`: the cube).
    texels : int
        Texels of the structure's images (`ldc`).
    packets, simd_rays : int
        Packets that hold rays, and the SIMD rays of which these are made (`packet`).
    by_depth : dict of str to list of int
        Counts by depth in the hierarchy, the root first; see raystream.packet.COUNTERS (`packet`).
    stages : dict of str to dict
        Per stage ``device`` seconds (kernels running) and ``wall`` seconds (with launch gaps).
    """

    levels: list = dataclasses.field(default_factory=list)
    mesh_tests: int = 0
    final_tests: int = 0
    final_hits: int = 0
    rays: int = 0
    triangles: int = 0
    peak_stream_bytes: int = 0
    batches: int = 0
    structure_bytes: int = 0
    texels: int = 0
    packets: int = 0
    simd_rays: int = 0
    by_depth: dict = dataclasses.field(default_factory=dict)
    stages: dict = dataclasses.field(default_factory=dict)

    @property
    def total_tests(self):
        """Sum of mesh tests, level tests and final tests."""
        return self.mesh_tests + self.final_tests + sum(level["tests"] for level in self.levels)

    @property
    def tests_by_depth(self):
        """Tests of SIMD rays against boxes and triangles by depth in the hierarchy (`packet`)."""
        kinds = (self.by_depth.get(name, []) for name in ("box_tests", "triangle_tests"))
        return [boxes + triangles for boxes, triangles in zip(*kinds, strict=True)]

    @property
    def bytes_per_triangle(self):
        """`structure_bytes` for each triangle."""
        return self.structure_bytes / max(1, self.triangles)

    @property
    def bytes_per_texel(self):
        """`structure_bytes` for each texel; 0 where there are none."""
        return self.structure_bytes / self.texels if self.texels else 0.0

    def to_dict(self):
        """The attributes and what is derived from them, as plain Python objects."""
        derived = ("total_tests", "tests_by_depth", "bytes_per_triangle", "bytes_per_texel")
        return {**dataclasses.asdict(self), **{name: getattr(self, name) for name in derived}}

    def add(self, other):
        """Add the counts and times of `other`: the sum over a frame's ray streams.

        Levels are matched from the leaves up, since streams differ in their number of levels.
        """
        for name in _SUMMED:
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("triangles", "peak_stream_bytes", "structure_bytes", "texels"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))
        missing = len(other.levels) - len(self.levels)
        empty = {"nodes": 0, "tests": 0, "hits": 0, "misses": 0}
        self.levels = [dict(empty) for _ in range(missing)] + self.levels
        for mine, theirs in zip(reversed(self.levels), reversed(other.levels), strict=False):
            for key in empty:
                mine[key] += theirs[key]
        for name, counts in other.by_depth.items():
            pairs = itertools.zip_longest(self.by_depth.get(name, []), counts, fillvalue=0)
            self.by_depth[name] = [a + b for a, b in pairs]
        for stage, seconds in other.stages.items():
            mine = self.stages.setdefault(stage, {"wall": 0.0, "device": 0.0})
            for key in mine:
                mine[key] += seconds[key]


class StageClock:
    """Collects the events of launches by stage and turns them into seconds.

    The queue is in order, so a launch's share of the wall clock is the time from the end of the
    launch before it to its own end: device time plus the gap that its launch cost.
    """

    def __init__(self):
        self._events = []
        self._user = None

    def record(self, stage, event):
        """Note that `event` belongs to `stage`, or to the stage it is `under`."""
        self._events.append((self._user or stage, event))

    @contextlib.contextmanager
    def under(self, stage):
        """File all that is recorded inside under `stage`: for primitives that a stage uses.

        Of nested ones the innermost decides.
        """
        outer, self._user = self._user, stage
        try:
            yield
        finally:
            self._user = outer

    def forget(self):
        """Drop what has been recorded: for calls whose times nobody asks for."""
        self._events.clear()

    def take(self):
        """Seconds by stage since the last `take`; the events must have completed."""
        return seconds_by_stage(self.hand_over())

    def hand_over(self):
        """What has been recorded since, for `seconds_by_stage` to read later."""
        events, self._events = self._events, []
        return events


def seconds_by_stage(events):
    """Seconds by stage of (stage, event) pairs in the order of the queue, all completed."""
    stages, last_end = {}, None
    for stage, event in events:
        profile = event.profile
        start, end = profile.start, profile.end
        begin = profile.queued if last_end is None else last_end
        seconds = stages.setdefault(stage, {"wall": 0.0, "device": 0.0})
        seconds["device"] += (end - start) * 1e-9
        seconds["wall"] += max(end - begin, end - start) * 1e-9
        last_end = end
    return stages
