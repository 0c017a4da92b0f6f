"""Light sources without extent: point, directional and spot."""

from dataclasses import dataclass

import numpy as np

from raystream.checks import check_color, check_number, check_vector


@dataclass(frozen=True, eq=False)
class PointLight:
    """A light that shines from a point in all directions.

    Parameters
    ----------
    position : (3,) float64
    color : (3,) float32
        Linear RGB intensity; a single number stands for three equal channels.
    falloff : bool
        Divide by the squared distance; otherwise the light is equally strong everywhere.

    Raises
    ------
    ValueError
        If a value is not finite or a colour is negative.
    """

    position: np.ndarray
    color: np.ndarray = 1.0
    falloff: bool = False

    def __post_init__(self):
        object.__setattr__(self, "position", check_vector("position", self.position))
        object.__setattr__(self, "color", check_color("color", self.color))
        object.__setattr__(self, "falloff", bool(self.falloff))


@dataclass(frozen=True, eq=False)
class DirectionalLight:
    """A light infinitely far away.

    Parameters
    ----------
    direction : (3,) float64
        The direction in which the light travels; need not be normalised.
    color : (3,) float32
        Linear RGB; a single number stands for three equal channels.

    Raises
    ------
    ValueError
        If the direction is zero, a value is not finite or a colour is negative.
    """

    direction: np.ndarray
    color: np.ndarray = 1.0

    def __post_init__(self):
        object.__setattr__(self, "direction", check_vector("direction", self.direction, True))
        object.__setattr__(self, "color", check_color("color", self.color))


@dataclass(frozen=True, eq=False)
class SpotLight:
    """A point light limited to a cone.

    Parameters
    ----------
    position : (3,) float64
    direction : (3,) float64
        Axis of the cone, in the direction in which the light travels; need not be normalised.
    color : (3,) float32
        Linear RGB intensity on the axis; a single number stands for three equal channels.
    inner_angle, outer_angle : float
        Half angles of the cone in degrees: full strength inside the inner one, none outside
        the outer one; 0 <= inner <= outer <= 180.
    falloff : bool
        Divide by the squared distance.

    Raises
    ------
    ValueError
        If a value is not finite, the direction is zero or the angles are out of order.
    """

    position: np.ndarray
    direction: np.ndarray
    color: np.ndarray = 1.0
    inner_angle: float = 20.0
    outer_angle: float = 30.0
    falloff: bool = False

    def __post_init__(self):
        object.__setattr__(self, "position", check_vector("position", self.position))
        object.__setattr__(self, "direction", check_vector("direction", self.direction, True))
        object.__setattr__(self, "color", check_color("color", self.color))
        outer = check_number(
            "outer_angle", self.outer_angle, lambda x: 0 < x <= 180, "degrees above 0 and up to 180"
        )
        inner = check_number(
            "inner_angle",
            self.inner_angle,
            lambda x: 0 <= x <= outer,
            f"degrees from 0 to outer_angle = {outer:g}",
        )
        object.__setattr__(self, "outer_angle", outer)
        object.__setattr__(self, "inner_angle", inner)
        object.__setattr__(self, "falloff", bool(self.falloff))
