"""Surface materials of the Whitted model, and how file materials become one.

What the renderer makes of a material (the model is written out in cl/shade.cl):

- an opaque share (1 - transmission) (1 - reflectivity) shows `diffuse`, lit;
- a share (1 - transmission) reflectivity shows the mirror ray;
- a share `transmission` is divided between mirror and refracted ray by Fresnel's equations with
  `ior`;
- highlights (`specular`, `shininess`) and `emission` are added.

glTF 2.0, metallic-roughness (all factors are linear; the defaults are those of the standard):

=====================================  ========================================================
glTF                                   Material
=====================================  ========================================================
metallicFactor, roughnessFactor        m = metallicFactor * (1 - roughnessFactor)^2
baseColorFactor RGB, m                 reflectivity = m RGB
baseColorFactor RGB, m, t              diffuse = RGB (1 - m) (1 - t) / opaque share
roughnessFactor r                      shininess = 2 / r^4 - 2, between 1 and 1000
metallicFactor                         specular = 0.04 (1 - metallicFactor) + m RGB
KHR_materials_transmission t           transmission = t RGB
baseColorFactor alpha < 1              transmission = t = 1 - alpha, without that extension
KHR_materials_ior                      ior (1.5 without it)
emissiveFactor                         emission; 0 with an emissiveTexture, which is not read
baseColorTexture                       texture (multiplies diffuse; its alpha is not read)
=====================================  ========================================================

m is the mirrored share; the rough share of a metal, which one ray cannot render, stays diffuse.
Division by the opaque share (1 - transmission) (1 - reflectivity) makes it show RGB (1 - m)
(1 - t), whatever the tints of mirror and glass.

Wavefront MTL (values are taken as linear, the common reading of the format):

=====================================  ========================================================
MTL                                    Material
=====================================  ========================================================
d (or 1 - Tr), Tf                      transmission = (1 - d) Tf (Tf: 1 where not given)
Kd                                     diffuse = d Kd / (1 - transmission)
Ks, Ns                                 specular, shininess
illum 3 or 5                           reflectivity = Ks
Ni                                     ior
Ke                                     emission
map_Kd                                 texture (multiplies diffuse; Kd is 1 where not given)
=====================================  ========================================================
"""

from dataclasses import dataclass

import numpy as np

from raystream.checks import check_color, check_number

_DEFAULT_DIFFUSE = 0.8
_DIELECTRIC_SPECULAR = 0.04
_MAX_SHININESS = 1000.0
_SMALLEST_SHARE = 1e-6  # below this nothing is opaque, and the diffuse colour does not matter


@dataclass(frozen=True, eq=False)
class Material:
    """How a surface reflects, transmits and emits light.

    Colours are linear RGB; a single number stands for three equal channels.

    Parameters
    ----------
    name : str
    diffuse : (3,) float32
        Lambertian colour.
    specular : (3,) float32
        Colour of the highlight of a light source.
    shininess : float
        Exponent of the highlight, >= 0.
    reflectivity : (3,) float32
        Share of light that an opaque surface mirrors, 0 to 1.
    transmission : (3,) float32
        Share of light that passes or is reflected as at glass, 0 to 1; its tint is the glass's.
    ior : float
        Index of refraction inside the surface, > 0.
    emission : (3,) float32
        Light given off, added to the surface's colour; it lights nothing else.
    texture : (h, w, 3) uint8, optional
        sRGB-encoded image that multiplies `diffuse`; the first row is the top (v = 1).

    Raises
    ------
    ValueError
        If a value is out of its range.
    """

    name: str = ""
    diffuse: np.ndarray = _DEFAULT_DIFFUSE
    specular: np.ndarray = 0.0
    shininess: float = 32.0
    reflectivity: np.ndarray = 0.0
    transmission: np.ndarray = 0.0
    ior: float = 1.5
    emission: np.ndarray = 0.0
    texture: np.ndarray | None = None

    def __post_init__(self):
        checked = {
            "name": str(self.name),
            "diffuse": check_color("diffuse", self.diffuse),
            "specular": check_color("specular", self.specular),
            "shininess": check_number(
                "shininess", self.shininess, lambda x: x >= 0, "a number >= 0"
            ),
            "reflectivity": check_color("reflectivity", self.reflectivity, largest=1.0),
            "transmission": check_color("transmission", self.transmission, largest=1.0),
            "ior": check_number("ior", self.ior, lambda x: x > 0, "a number > 0"),
            "emission": check_color("emission", self.emission),
            "texture": _check_texture(self.texture),
        }
        for field, value in checked.items():
            object.__setattr__(self, field, value)  # the dataclass is frozen


def _check_texture(texture):
    if texture is None:
        return None
    image = np.asarray(texture)
    if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or image.size == 0:
        raise ValueError(f"texture: need uint8 (h, w, 3), got {image.dtype} {image.shape}")
    return np.ascontiguousarray(image)


def srgb_to_linear(encoded):
    """Decode sRGB (IEC 61966-2-1).

    Parameters
    ----------
    encoded : (...) uint8
        Encoded channel values, 0 to 255.

    Returns
    -------
    (...) float32
        Linear values, 0 to 1.
    """
    s = np.arange(256) / 255.0
    table = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return table.astype(np.float32)[np.asarray(encoded, dtype=np.uint8)]


def from_gltf(
    name="",
    base_color=(1, 1, 1, 1),
    metallic=1.0,
    roughness=1.0,
    emissive=0.0,
    texture=None,
    transmission=None,
    ior=1.5,
):
    """Map a glTF metallic-roughness material; the table is in the module's docstring.

    Parameters
    ----------
    name : str
    base_color : (4,) float
        baseColorFactor, linear RGB and alpha, 0 to 1.
    metallic, roughness : float
        metallicFactor and roughnessFactor, 0 to 1.
    emissive : float or (3,) float
    texture : (h, w, 3) uint8, optional
    transmission : float, optional
        transmissionFactor, tinted by the base colour; without it 1 - alpha, not tinted.
    ior : float

    Returns
    -------
    Material
    """
    rgb, alpha = np.asarray(base_color[:3], dtype=np.float64), float(base_color[3])
    if transmission is None:
        passing, tint = 1.0 - alpha, 1.0
    else:
        passing, tint = transmission, rgb
    mirror = metallic * (1.0 - roughness) ** 2
    opaque = (1.0 - passing * tint) * (1.0 - mirror * rgb)
    return Material(
        name=name,
        diffuse=rgb * (1.0 - mirror) * (1.0 - passing) / np.maximum(opaque, _SMALLEST_SHARE),
        specular=_DIELECTRIC_SPECULAR * (1.0 - metallic) + rgb * mirror,
        shininess=np.clip(2.0 / max(roughness, 1e-3) ** 4 - 2.0, 1.0, _MAX_SHININESS),
        reflectivity=rgb * mirror,
        transmission=passing * tint,
        ior=ior,
        emission=emissive,
        texture=texture,
    )


def from_mtl(name, properties, texture=None):
    """Map a Wavefront MTL material; the table is in the module's docstring.

    Parameters
    ----------
    name : str
    properties : dict
        Lower-case MTL key to the value's words or numbers: a sequence or a single one.
    texture : (h, w, 3) uint8, optional
        The image of map_Kd.

    Returns
    -------
    Material

    Raises
    ------
    ValueError
        If a value is no number or out of range; the message names the material.
    """
    try:
        return _from_mtl(name, {key.lower(): value for key, value in properties.items()}, texture)
    except ValueError as error:
        raise ValueError(f"material {name!r}: {error}") from None


def _from_mtl(name, properties, texture):
    if "d" in properties:
        opacity = _numbers(properties, "d", 1.0)[-1]  # the last word: "d -halo 0.5" is allowed
    else:
        opacity = 1.0 - _numbers(properties, "tr", 0.0)[0]
    specular = _rgb(properties, "ks", 0.0)
    mirror = int(_numbers(properties, "illum", 2)[0]) in (3, 5)
    diffuse = _rgb(properties, "kd", _DEFAULT_DIFFUSE if texture is None else 1.0)
    transmission = (1.0 - opacity) * _rgb(properties, "tf", 1.0)
    return Material(
        name=name,
        diffuse=opacity * diffuse / np.maximum(1.0 - transmission, _SMALLEST_SHARE),
        specular=specular,
        shininess=_numbers(properties, "ns", 32.0)[0],
        reflectivity=specular if mirror else 0.0,
        transmission=transmission,
        ior=_numbers(properties, "ni", 1.5)[0],
        emission=_rgb(properties, "ke", 0.0),
        texture=texture,
    )


def _numbers(properties, key, default):
    """The numbers of one MTL line, as a float64 array of at least one entry."""
    value = np.atleast_1d(properties.get(key, default))
    if key == "d":
        value = value[-1:]
    try:
        return value.astype(np.float64)
    except ValueError:
        raise ValueError(f"{key}: need numbers, got {value.tolist()}") from None


def _rgb(properties, key, default):
    """One MTL colour; a single number stands for three equal channels."""
    return check_color(key, _numbers(properties, key, default)).astype(np.float64)
