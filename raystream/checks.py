"""Checks of arguments: one line that says what was wanted, what came and which element."""

import numpy as np

_SHOWN = 80  # characters of a refused value that a message shows


def as_float_array(name, value, shape):
    """`value` as a C-contiguous float32 array of `shape` (None: any length).

    Raises
    ------
    TypeError
        The dtype cannot be cast to float32 safely within its kind (complex, strings, objects).
    ValueError
        Wrong shape.
    """
    array = np.asarray(value)
    if array.dtype.kind not in "fiub":
        raise TypeError(f"{name}: need real numbers, got dtype {array.dtype}")
    if array.ndim != len(shape) or any(
        n is not None and n != m for n, m in zip(shape, array.shape, strict=True)
    ):
        wanted = ", ".join("n" if n is None else str(n) for n in shape)
        raise ValueError(f"{name}: need shape ({wanted}), got {array.shape}")
    with np.errstate(over="ignore"):  # what leaves float32's range is infinite, refused below
        return np.ascontiguousarray(array, dtype=np.float32)


def check_rows(name, wanted, good):
    """Raise a ValueError that names the first rows where `good` (n,) is False."""
    if not good.all():
        bad = np.flatnonzero(~good)
        more = "" if len(bad) == 1 else f" and {len(bad) - 1} more"
        raise ValueError(f"{name}: need {wanted}, not so at index {bad[0]}{more}")


def check_choice(name, value, choices):
    """Raise a ValueError with the list of `choices` unless `value` is one of them."""
    if not any(type(value) is type(choice) and value == choice for choice in choices):
        listed = ", ".join(repr(c) for c in choices)
        raise ValueError(f"{name}: need one of {listed}, got {value!r}")


def check_count(name, value, least=1):
    """`value` as int; ValueError unless it is a whole number of at least `least`."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise ValueError(f"{name}: need a whole number of at least {least}, got {value!r}")
    return int(value)


def check_type(name, value, wanted):
    """`value` itself; TypeError unless it is an instance of `wanted`, a class or several."""
    if not isinstance(value, wanted):
        kinds = wanted if isinstance(wanted, tuple) else (wanted,)
        names = " or ".join(kind.__name__ for kind in kinds)
        raise TypeError(f"{name}: need {names}, got {type(value).__name__}")
    return value


def check_types(name, values, wanted):
    """`values` as a tuple; TypeError that names the first which is no instance of `wanted`."""
    if not np.iterable(values):
        raise TypeError(f"{name}: need a sequence, got {type(values).__name__}")
    return tuple(check_type(f"{name}[{i}]", value, wanted) for i, value in enumerate(values))


def check_number(name, value, good, wanted):
    """`value` as a float for which `good` holds.

    Raises
    ------
    ValueError
        It is no finite number, or not a good one; `wanted` says in words what was needed.
    """
    number = float(_as_floats(name, value, wanted, ()))
    if not (np.isfinite(number) and good(number)):
        raise ValueError(f"{name}: need {wanted}, got {_shown(value)}")
    return number


def check_vector(name, value, nonzero=False):
    """`value` as (3,) float64.

    Raises
    ------
    ValueError
        It is not three finite numbers, or has no length where `nonzero` is asked.
    """
    vector = _as_floats(name, value, "3 finite numbers", (3,))
    if not np.isfinite(vector).all():
        raise ValueError(f"{name}: need 3 finite numbers, got {_shown(value)}")
    if nonzero and not vector.any():
        raise ValueError(f"{name}: need a vector of nonzero length, got {_shown(value)}")
    return vector


def check_color(name, value, largest=np.inf):
    """`value` as (3,) float32, linear RGB; a single number stands for three equal channels.

    Raises
    ------
    ValueError
        It is no number or three of them, or a channel is not from 0 to `largest` and finite.
    """
    channels = _as_floats(name, value, "a number or 3 numbers", (), (1,), (3,))
    with np.errstate(over="ignore"):  # what leaves float32's range is infinite, refused below
        color = np.broadcast_to(channels.astype(np.float32), (3,)).copy()
    # written so that NaN fails too
    if not np.all((color >= 0) & (color <= largest) & np.isfinite(color)):
        wanted = "finite and >= 0" if np.isinf(largest) else f"from 0 to {largest:g}"
        raise ValueError(f"{name}: need values {wanted}, got {_shown(value)}")
    return color


def check_size(size):
    """(width, height) as integers; ValueError unless both are positive integers."""
    try:
        values = np.asarray(size)
    except ValueError:  # of differing lengths
        values = np.empty(0)
    if values.shape != (2,) or values.dtype.kind not in "iu" or (values < 1).any():
        raise ValueError(f"size: need (width, height), positive integers, got {_shown(size)}")
    return int(values[0]), int(values[1])


def _as_floats(name, value, wanted, *shapes):
    """A copy of `value` as float64 of one of those shapes; ValueError if it is none."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        array = None
    if array is None or array.shape not in shapes:
        raise ValueError(f"{name}: need {wanted}, got {_shown(value)}")
    return array


def _shown(value):
    """A refused value in one line."""
    text = " ".join(repr(value).split())
    return text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "..."
