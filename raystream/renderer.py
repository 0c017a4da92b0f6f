"""The frame: primary visibility by rasterisation, then Whitted's recursion over ray streams."""

import dataclasses

import numpy as np

from raystream import device as devices
from raystream import image as images
from raystream import intersect, rays
from raystream.camera import Camera, check_size
from raystream.checks import check_choice, check_count
from raystream.geometry import Geometry
from raystream.host_tracer import HostTracer
from raystream.intersect import HitStream
from raystream.rasterize import Rasterizer
from raystream.scene import as_scene
from raystream.shade import Shader
from raystream.statistics import SHADING, Statistics
from raystream.tracer import AUTO, Tracer

SHADOW, REFLECTION, REFRACTION = RAY_KINDS = ("shadow", "reflection", "refraction")
PRIMARY = "primary"
PRIMARY_VISIBILITY = ("raster", "trace")
# The R2 sequence (Roberts 2018): sample k of a pixel is frac(1/2 + k * these), sample 0 its centre.
_R2 = np.array([0.7548776662466927, 0.5698402909980532])


@dataclasses.dataclass
class Frame:
    """A rendered picture.

    Attributes
    ----------
    image : (height, width, 3) float32
        Linear RGB, top row first.
    depth : (height, width) float32
        Distance along the view direction of the first sample's primary hit, inf where none.
    geom_id, prim_id : (height, width) int32
        Of that hit, -1 where none.
    statistics : raystream.statistics.Statistics
        Summed over all ray streams of the frame, with the times of all stages.
    kinds : dict of str to raystream.statistics.Statistics
        The same by kind of ray, "primary" (where traced), "shadow", "reflection" and "refraction",
        for kinds that had rays.
        Stage times only where `Renderer.render` was asked for them.
    """

    image: np.ndarray
    depth: np.ndarray
    geom_id: np.ndarray
    prim_id: np.ndarray
    statistics: Statistics
    kinds: dict

    def save(self, path):
        """Write the image by suffix: .png and .jpg in sRGB, .exr and .npy linear."""
        images.save(path, self.image)


def render(
    scene,
    camera=None,
    size=(512, 512),
    method=AUTO,
    max_bounces=2,
    shadows=True,
    samples=1,
    device=None,
    progress=None,
    primary="raster",
    **options,
):
    """Render a scene: see `Renderer`, which keeps its state between frames.

    Parameters
    ----------
    scene : raystream.Scene, trimesh.Trimesh or trimesh.Scene
    camera : raystream.Camera, optional
        Default: the scene's.
    size : (int, int)
        (width, height) in pixels.
    method : str or tracer
        One of `methods`, "auto", a `Tracer`, or an object of the same protocol, such as an
        `EmbreeTracer`.
    max_bounces : int
        Generations of reflection and refraction rays.
    shadows : bool
        Trace shadow rays; otherwise every light reaches every surface that faces it.
    samples : int
        Samples per pixel.
    device : pyopencl.Device, optional
    progress : callable, optional
        Called with (samples done, samples) after each sample.
    primary : {"raster", "trace"}
        How to find what the camera sees: by rasterisation, or by the method's rays.
    **options
        Of the method, and `memory_limit`.

    Returns
    -------
    Frame

    Raises
    ------
    ValueError, TypeError
        Names the argument, what was wanted and what came.
    """
    scene = as_scene(scene)
    renderer = Renderer(scene, method, device, **options)
    return renderer.render(
        camera, size, max_bounces, shadows, samples, progress, primary=primary
    )


class Renderer:
    """Renders frames of one scene by one tracer; buffers and shading data stay on the device.

    Parameters
    ----------
    scene, method, device, **options
        As for `render`.
    """

    def __init__(self, scene, method=AUTO, device=None, **options):
        self.scene = as_scene(scene)
        self._tracer = _tracer(self.scene, method, device, options)
        if device is None and isinstance(self._tracer, Tracer):
            device = self._tracer.device
        self._session = devices.session(device)
        geometry = (
            self._tracer.geometry(self._session)
            if isinstance(self._tracer, Tracer)
            else Geometry(self._session, self.scene)
        )
        self._geometry = geometry
        self._rasterizer = Rasterizer(self._session)
        self._shader = Shader(self._session, geometry, self.scene)

    def render(
        self,
        camera=None,
        size=(512, 512),
        max_bounces=2,
        shadows=True,
        samples=1,
        progress=None,
        stages_by_kind=False,
        primary="raster",
    ):
        """Render one frame; parameters and result as for `raystream.render`.

        Parameters
        ----------
        stages_by_kind : bool
            Fill the stage times of `Frame.kinds`, too: of the tracer's work, not of making and
            shading the rays. Waits for the device before and after every ray stream.
        """
        camera = self.scene.camera if camera is None else camera
        if not isinstance(camera, Camera):
            raise TypeError(f"camera: need a raystream.Camera, got {type(camera).__name__}")
        width, height = check_size(size)
        check_count("max_bounces", max_bounces, least=0)
        check_count("samples", samples)
        check_choice("primary", primary, PRIMARY_VISIBILITY)
        if isinstance(self._tracer, Tracer):
            self._tracer.geometry(self._session)  # takes vertices updated since the last frame
        counts = _Counts(self._session, self.scene.num_triangles, stages_by_kind)
        self._session.clock.forget()
        image = self._session.empty((width * height, 4), np.float32)
        self._session.fill(SHADING, image, 0)
        visible = None
        for sample in range(samples):
            offset = (0.5 + sample * _R2) % 1.0
            view = rays.from_camera(self._session, camera, (width, height), offset)
            if primary == "trace":
                hits = counts.trace(PRIMARY, self._tracer, self._tracer.intersect_stream, view)
            else:
                hits = self._rasterize(camera, (width, height), offset)
            self._sample(view, hits, max_bounces, shadows, image, counts)
            visible = visible or self._visible(hits)
            counts.take_stages()
            if progress is not None:
                progress(sample + 1, samples)
        linear = image.get().reshape(height, width, 4)[..., :3] / np.float32(samples)
        visible = [field.reshape(height, width) for field in visible]
        return Frame(np.ascontiguousarray(linear), *visible, counts.total, counts.kinds())

    def _sample(self, stream, hits, max_bounces, shadows, image, counts):
        """Add one sample per pixel to the image, given the camera's rays and their hits."""
        session, shader = self._session, self._shader
        weights = session.empty((len(stream), 4), np.float32)
        session.fill(SHADING, weights, 1)
        pending, bounce = [], 0
        while True:
            surfaces = shader.evaluate(hits, stream, weights, image)
            self._light(stream, surfaces, weights, shadows, image, counts)
            if bounce < max_bounces:
                reflected, refracted = shader.spawn(stream, surfaces, weights)
                # The reflection is taken up first; waiting streams stay few, a pair per bounce.
                spawned = ((REFRACTION, *refracted), (REFLECTION, *reflected))
                pending += [(kind, r, w, bounce + 1) for kind, r, w, alive in spawned if alive]
            if not pending:
                return
            kind, stream, weights, bounce = pending.pop()
            hits = counts.trace(kind, self._tracer, self._tracer.intersect_stream, stream)

    def _rasterize(self, camera, size, offset):
        hits = self._rasterizer.render(
            self._geometry.triangles, camera, size, offset, self._geometry.num_triangles
        )
        return HitStream(hits.t, hits.prim, hits.u, hits.v)

    def _light(self, stream, surfaces, weights, shadows, image, counts):
        for light in range(self._shader.num_lights):
            shadow_rays = self._shader.shadow_rays(light, surfaces, weights, stream.size)
            if shadows:
                blocked = counts.trace(
                    SHADOW, self._tracer, self._tracer.occluded_stream, shadow_rays
                )
            else:
                blocked = intersect.not_blocked(self._session, len(stream))
            self._shader.add_light(light, blocked, stream, surfaces, weights, image)

    def _visible(self, hits):
        geom_id, prim_id = intersect.split_ids(self._session, hits, self._geometry)
        return [hits.t.get(), geom_id.get(), prim_id.get()]


class _Counts:
    """The statistics of a frame, of all its ray streams and by kind of ray."""

    def __init__(self, session, triangles, stages_by_kind):
        self.total = Statistics(triangles=triangles)
        self._session, self._stages_by_kind = session, stages_by_kind
        self._by_kind = {kind: Statistics(triangles=triangles) for kind in (PRIMARY, *RAY_KINDS)}

    def kinds(self):
        """The statistics of the kinds that had rays."""
        return {kind: counts for kind, counts in self._by_kind.items() if counts.rays}

    def take_stages(self):
        """Add the stage times since they were last taken; waits for the device."""
        self.total.add(Statistics(stages=self._session.finish()))

    def trace(self, kind, tracer, query, stream):
        """What a tracer's query says about a stream of one kind of ray; adds what it counted."""
        if self._stages_by_kind:
            self.take_stages()  # of what came before the stream
        answer = query(self._session, stream)
        if self._stages_by_kind:
            tracer.statistics.stages = self._session.finish()
        for counts in (self.total, self._by_kind[kind]):
            counts.add(tracer.statistics)
        return answer


def parse_method(text, known):
    """A method with options as the command line writes it: "rsh:arity=8:levels=none".

    Parameters
    ----------
    text : str
        The name, then any number of ":key=value". Values are whole numbers, numbers, true, false
        or none; anything else stays text.
    known : sequence of str
        The names that there are.

    Returns
    -------
    str, dict
        The name; the options, whose keys are the method's to check.

    Raises
    ------
    ValueError
        An unknown name (with the list), a part that is not key=value, a key given twice.
    """
    name, *parts = text.split(":")
    check_choice("method", name, known)
    options = {}
    for part in parts:
        key, equals, value = part.partition("=")
        if not (key and equals) or key in options:
            raise ValueError(f"method {name!r}: need key=value, each key once, got {part!r}")
        options[key] = _value(value)
    return name, options


def _value(text):
    words = {"true": True, "false": False, "none": None}
    if text.lower() in words:
        return words[text.lower()]
    for number in (int, float):
        try:
            return number(text)
        except ValueError:
            pass  # the next kind
    return text


def _tracer(scene, method, device, options):
    if isinstance(method, str):
        return Tracer(scene, method, device, **options)
    if options:
        raise ValueError(f"options are for methods given by name, got {', '.join(options)}")
    if isinstance(method, Tracer):
        if method.scene.num_triangles != scene.num_triangles:
            raise ValueError(
                f"method: the tracer holds {method.scene.num_triangles} triangles, "
                f"the scene {scene.num_triangles}"
            )
        return method
    for name in ("intersect", "occluded"):
        if not callable(getattr(method, name, None)):
            raise TypeError(f"method: need a name or a tracer, got {type(method).__name__}")
    return HostTracer(method, scene)
