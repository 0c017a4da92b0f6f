"""Ray queries and Whitted rendering in OpenCL for scenes that change every frame.

>>> import raystream as rs
>>> frame = rs.render(rs.scenes.demo(), size=(640, 360))
>>> frame.save("demo.png")
"""

from raystream import scenes, stream
from raystream._version import __version__
from raystream.camera import Camera
from raystream.cube import LayeredDepthCube
from raystream.device import devices
from raystream.hierarchy import RayHierarchy
from raystream.light import DirectionalLight, PointLight, SpotLight
from raystream.material import Material
from raystream.mesh import Mesh
from raystream.renderer import Frame, Renderer, render
from raystream.scene import Scene, load_scene
from raystream.tracer import Hits, Tracer, methods

__all__ = [
    "Camera",
    "DirectionalLight",
    "Frame",
    "Hits",
    "LayeredDepthCube",
    "Material",
    "Mesh",
    "PointLight",
    "RayHierarchy",
    "Renderer",
    "Scene",
    "SpotLight",
    "Tracer",
    "__version__",
    "devices",
    "load_scene",
    "methods",
    "render",
    "scenes",
    "stream",
]
