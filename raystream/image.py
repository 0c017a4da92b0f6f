"""Images: encoding, saving, comparing. Linear RGB float32 inside, sRGB in 8-bit files."""

import pathlib

import numpy as np

SUFFIXES = (".png", ".jpg", ".jpeg", ".exr", ".npy")


def to_srgb(linear):
    """8-bit sRGB of a linear image; values outside 0..1 are clipped.

    Parameters
    ----------
    linear : (height, width, 3) float

    Returns
    -------
    (height, width, 3) uint8
    """
    x = np.clip(linear, 0.0, 1.0)
    encoded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    return (encoded * 255 + 0.5).astype(np.uint8)


def check_suffix(path):
    """`path` as a Path; ValueError unless its suffix is one that `save` knows."""
    path = pathlib.Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: need a file name that ends in one of {', '.join(SUFFIXES)}")
    return path


def save(path, image):
    """Write an image: .png and .jpg as 8-bit sRGB, .exr and .npy linear, unclipped.

    Parameters
    ----------
    path : path-like
    image : (height, width, 3) float32, linear RGB, or uint8, already encoded

    Raises
    ------
    ValueError
        A suffix that is not known.
    OSError
        The file cannot be written.
    """
    path = check_suffix(path)
    suffix = path.suffix.lower()
    if suffix == ".npy":
        np.save(path, image)
    elif suffix == ".exr":
        _save_exr(path, np.ascontiguousarray(image, np.float32))
    else:
        import imageio.v3 as imageio

        imageio.imwrite(path, image if image.dtype == np.uint8 else to_srgb(image))


def _save_exr(path, image):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path.touch()  # a folder that is not there is an OSError, as for the other formats
    with OpenEXR.File(header, {"RGB": image}) as file:
        file.write(str(path))
