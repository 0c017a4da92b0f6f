import numpy as np
import pytest

from raystream.light import DirectionalLight, PointLight, SpotLight


def test_defaults():
    point = PointLight((1, 2, 3))
    assert point.position.tolist() == [1, 2, 3] and point.position.dtype == np.float64
    assert point.color.tolist() == [1, 1, 1] and point.color.dtype == np.float32
    assert point.falloff is False
    spot = SpotLight((0, 1, 0), (0, -2, 0))
    assert (spot.inner_angle, spot.outer_angle, spot.falloff) == (20.0, 30.0, False)
    assert spot.direction.tolist() == [0, -2, 0]
    assert DirectionalLight((0, 0, -1), 0.5).color.tolist() == [0.5] * 3


def test_lights_do_not_alias_the_callers_array():
    position = np.zeros(3)
    light = PointLight(position)
    position[:] = 7
    assert not light.position.any()


@pytest.mark.parametrize(
    "make, field",
    [
        (lambda: PointLight((0, np.nan, 0)), "position"),
        (lambda: PointLight((0, 0)), "position"),
        (lambda: PointLight("here"), "position"),
        (lambda: PointLight((0, 0, 0), -1), "color"),
        (lambda: PointLight((0, 0, 0), [1, 1, np.inf]), "color"),
        (lambda: DirectionalLight((0, 0, 0)), "direction"),
        (lambda: DirectionalLight((0, np.inf, 0)), "direction"),
        (lambda: SpotLight((0, 0, 0), (0, 0, 0)), "direction"),
        (lambda: SpotLight((0, 0, 0), (0, 0, 1), outer_angle=181), "outer_angle"),
        (lambda: SpotLight((0, 0, 0), (0, 0, 1), outer_angle=0), "outer_angle"),
        (lambda: SpotLight((0, 0, 0), (0, 0, 1), inner_angle=31), "inner_angle"),
        (lambda: SpotLight((0, 0, 0), (0, 0, 1), inner_angle=np.nan), "inner_angle"),
    ],
)
def test_a_bad_value_is_refused_in_one_line_that_names_the_field(make, field):
    with pytest.raises(ValueError, match=f"^{field}: need .*got") as caught:
        make()
    assert "\n" not in str(caught.value)
