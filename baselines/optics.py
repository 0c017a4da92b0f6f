"""Reflection, refraction and Fresnel's equations for unit vectors."""

import numpy as np

from .surface import dot


def reflect(directions, normals):
    """Return the mirror directions, (n, 3)."""
    return directions - 2 * dot(directions, normals) * normals


def refract(directions, normals, eta):
    """Refract by Snell's law.

    Parameters
    ----------
    directions, normals : (n, 3) float64
        Unit vectors, the normals on the side of incidence.
    eta : (n, 1) float64
        Refractive index on the side of incidence over that on the other side.

    Returns
    -------
    refracted : (n, 3) float64
        Unit directions; meaningless where the reflection is total.
    total : (n,) bool
        Whether the reflection is total.
    """
    cos_i = -dot(directions, normals)
    cos_t_squared = 1 - eta**2 * (1 - cos_i**2)
    cos_t = np.sqrt(np.maximum(cos_t_squared, 0))
    return eta * directions + (eta * cos_i - cos_t) * normals, cos_t_squared[:, 0] < 0


def fresnel(directions, normals, eta):
    """Return the reflected share of unpolarised light, (n, 1); 1 where it is total or grazing.

    Born and Wolf, Principles of Optics, section 1.5.2: the mean of the two polarisations.
    Arguments as for `refract`.
    """
    cos_i = -dot(directions, normals)
    cos_t_squared = 1 - eta**2 * (1 - cos_i**2)
    total = (cos_t_squared < 0) | (cos_i <= 0)
    cos_i = np.where(total, 1.0, cos_i)  # keeps the quotients finite where they do not count
    cos_t = np.sqrt(np.maximum(cos_t_squared, 0))
    perpendicular = (eta * cos_i - cos_t) / (eta * cos_i + cos_t)
    parallel = (cos_i - eta * cos_t) / (cos_i + eta * cos_t)
    return np.where(total, 1.0, (perpendicular**2 + parallel**2) / 2)
