"""The real scenes of the tests and benchmarks: each with a camera and one point light.

The files are not part of the repository: `$RAYSTREAM_SCENES` names their folder.
"""

import dataclasses
import pathlib

import numpy as np

import raystream as rs

_SKY = (0.25, 0.35, 0.5)


@dataclasses.dataclass(frozen=True)
class RealScene:
    """How to set up one file; `ball`: mirror sphere x, y, z, radius; `mirror`: name pattern."""

    path: str
    eye: tuple
    target: tuple
    light: tuple
    fov_y: float = 45.0
    up: tuple = (0, 1, 0)
    ball: tuple | None = None
    mirror: str | None = None

    @property
    def name(self):
        return pathlib.Path(self.path).stem

    def load(self, folder):
        """The scene, ready to render."""
        scene = rs.load_scene(pathlib.Path(folder) / self.path)
        if self.ball is not None:
            scene.add(rs.scenes.mirror_ball(self.ball[:3], self.ball[3]))
        if self.mirror is not None:
            scene.mirror(self.mirror)
        scene.set_lights([rs.PointLight(self.light)])
        scene.background = np.array(_SKY, np.float32)
        return scene

    @property
    def camera(self):
        return rs.Camera.look_at(self.eye, self.target, self.up, self.fov_y)


BUNNY = RealScene(
    "bunny/bunny-69451.ply", (0, 0.11, 0.35), (-0.017, 0.11, 0), (0.2, 0.4, 0.4), mirror="*"
)
DRAGON = RealScene(
    "dragon/dragon-47794.ply", (0, 0.12, 0.4), (-0.006, 0.125, 0), (0.2, 0.4, 0.4),
    ball=(0.07, 0.075, 0.07, 0.03),
)  # fmt: skip
PATIO = RealScene(
    "sponza/sponza-dabrovic.obj", (-12, 4, 0), (-11, 3.95, 0.1), (-2, 9, 0), fov_y=60,
    ball=(-6, 3, 0.3, 1.5),
)  # fmt: skip
OFFICE = RealScene(
    "office/mgf-office.glb", (1.6, 3.0, -1.2), (1.0, 2.65, -0.2), (0, 3.6, 0.3), fov_y=70,
    ball=(0.4, 2.2, 0.9, 0.3),
)  # fmt: skip
KITCHEN = RealScene(
    "bart-kitchen/bart-kitchen.glb", (4.5, 1.2, 3.2), (1.0, 0.2, -1.0), (2.0, 2.3, 0.5),
    fov_y=60, ball=(2.2, 0.4, 0.6, 0.4),
)  # fmt: skip
GEARS = RealScene(
    "spd/gears-4.glb", (-1.1, -2.1, 2.6), (0, 0, 0), (2, -2.5, 2.5), up=(0, 0, 1),
    ball=(0.2, -0.4, 1.2, 0.3),
)  # fmt: skip
# What the tests check ray by ray: each has a mirror.
REAL_SCENES = [
    BUNNY,
    DRAGON,
    PATIO,
    OFFICE,
    KITCHEN,
    RealScene(
        "cornell-box/cornell-box-measured.obj", (278, 273, -800), (278, 273, 0), (278, 500, 200),
        fov_y=39.31, mirror="tall*",
    ),
    GEARS,
    RealScene(
        "fox/fox.glb", (-180, 60, 60), (0, 40, 0), (-150, 200, 150), ball=(20, 40, -50, 35)
    ),
]  # fmt: skip


def _bare(real):
    """The file alone, as the papers count it."""
    return dataclasses.replace(real, ball=None, mirror=None)


# What the benchmarks count. Rooms and views that fill the screen, with a light that nearly every
# visible point faces: Reis et al. (2017) have 251 546 shadow rays in office, 256 713 in sponza.
COUNT_SCENES = {
    "office": _bare(OFFICE),
    "sponza": dataclasses.replace(_bare(PATIO), light=(-10.5, 3, 2)),
    "kitchen": _bare(KITCHEN),
    "conference": RealScene(
        "conference/conference-331179.ply", (1300, 300, 100), (300, 100, -100), (1400, 600, 100),
        fov_y=60,
    ),
    "munich": RealScene(
        "munich/munich.glb", (-300, -300, 300), (-80, -80, 0), (-350, -200, 500), up=(0, 0, 1)
    ),
    "gears": _bare(GEARS),
    "rings": RealScene(
        "spd/rings-3.glb", (-1, -2.613, 0.5), (-1, -1.613, 0.5), (3, -2.613, 3), up=(0, 0, 1)
    ),
    "maple": RealScene(
        "foliage/japanese-maple.glb", (430, 380, 140), (76, 421, 131), (600, 480, 200), fov_y=25
    ),
    "bunny": _bare(BUNNY),
    "dragon": _bare(DRAGON),
}  # fmt: skip
