"""Encoding and saving pictures."""

import numpy as np
import pytest

from raystream import image as images

GRADIENT = np.linspace(0, 1.2, 5 * 7 * 3, dtype=np.float32).reshape(5, 7, 3)


def test_srgb_of_known_values():
    linear = np.array([[[-1, 0, 0.0031308], [0.5, 1, 7]]])
    np.testing.assert_array_equal(images.to_srgb(linear), [[[0, 0, 10], [188, 255, 255]]])


@pytest.mark.parametrize("suffix", [".png", ".PNG"])
def test_png_holds_srgb(tmp_path, suffix):
    import imageio.v3 as imageio

    images.save(tmp_path / f"a{suffix}", GRADIENT)
    np.testing.assert_array_equal(imageio.imread(tmp_path / f"a{suffix}"), images.to_srgb(GRADIENT))


def test_jpg_is_close(tmp_path):
    import imageio.v3 as imageio

    flat = np.full((16, 16, 3), 0.5, np.float32)
    images.save(tmp_path / "a.jpg", flat)
    read = imageio.imread(tmp_path / "a.jpg").astype(int)
    assert abs(read - images.to_srgb(flat)).max() <= 3


def test_exr_and_npy_are_linear_and_unclipped(tmp_path):
    import OpenEXR

    images.save(tmp_path / "a.npy", GRADIENT)
    np.testing.assert_array_equal(np.load(tmp_path / "a.npy"), GRADIENT)
    images.save(tmp_path / "a.exr", GRADIENT)
    with OpenEXR.File(str(tmp_path / "a.exr")) as file:
        np.testing.assert_array_equal(file.channels()["RGB"].pixels, GRADIENT)


def test_an_unknown_suffix_lists_the_known_ones(tmp_path):
    with pytest.raises(ValueError, match=r"a\.gif: need a file name that ends in one of \.png"):
        images.save(tmp_path / "a.gif", GRADIENT)


@pytest.mark.parametrize("suffix", images.SUFFIXES)
def test_a_folder_that_is_not_there_is_an_oserror(tmp_path, suffix):
    with pytest.raises(OSError):
        images.save(tmp_path / "gone" / f"a{suffix}", GRADIENT)
