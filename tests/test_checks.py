import numpy as np
import pytest

from raystream.checks import (
    as_float_array,
    check_choice,
    check_color,
    check_count,
    check_number,
    check_rows,
    check_size,
    check_type,
    check_types,
    check_vector,
)


def message_of(kind, function, *arguments):
    """The one line of the error that a call raises."""
    with pytest.raises(kind) as caught:
        function(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_arrays_become_contiguous_float32():
    array = as_float_array("a", np.arange(6).reshape(2, 3).T, (None, 2))
    assert array.dtype == np.float32 and array.flags.c_contiguous
    assert array.tolist() == [[0, 3], [1, 4], [2, 5]]
    assert np.isinf(as_float_array("a", [1e39], (1,)))


def test_a_wrong_shape_or_dtype_is_refused_with_both():
    shape = message_of(ValueError, as_float_array, "a", np.ones((4, 2)), (None, 3))
    assert shape == "a: need shape (n, 3), got (4, 2)"
    dtype = message_of(TypeError, as_float_array, "a", ["x"], (None,))
    assert dtype == "a: need real numbers, got dtype <U1"


def test_rows_name_the_first_bad_one_and_count_the_others():
    check_rows("a", "numbers", np.array([True, True]))
    one = message_of(ValueError, check_rows, "a", "numbers", np.array([True, False]))
    assert one == "a: need numbers, not so at index 1"
    more = message_of(ValueError, check_rows, "a", "numbers", np.array([False, True, False]))
    assert more == "a: need numbers, not so at index 0 and 1 more"


def test_choices_and_counts():
    check_choice("a", "x", ("x", "y"))
    assert message_of(ValueError, check_choice, "a", 1, ("x", "y")) == (
        "a: need one of 'x', 'y', got 1"
    )
    assert check_count("a", np.int8(3)) == 3
    for value in (0, True, 1.0, "1"):
        message = message_of(ValueError, check_count, "a", value)
        assert message == f"a: need a whole number of at least 1, got {value!r}"


def test_types_name_the_element():
    assert check_type("a", 1, int) == 1
    assert message_of(TypeError, check_type, "a", 1, str) == "a: need str, got int"
    assert check_types("a", iter([1, 2]), int) == (1, 2)
    message = message_of(TypeError, check_types, "a", [1, "x", 2.0], (int, float))
    assert message == "a[1]: need int or float, got str"
    assert message_of(TypeError, check_types, "a", 5, int) == "a: need a sequence, got int"


def test_numbers():
    number = check_number("a", np.float32(0.5), lambda x: x > 0, "a number > 0")
    assert number == 0.5 and type(number) is float


@pytest.mark.parametrize(
    "value, shown",
    [
        (0, "0"),
        (np.nan, "nan"),
        (np.inf, "inf"),
        (None, "None"),
        ("x", "'x'"),
        ([1], "[1]"),
        (1j, "1j"),
        (10**400, "1" + 76 * "0" + "..."),
        (np.zeros((2, 2)), "array([[0., 0.], [0., 0.]])"),
    ],
)
def test_what_is_no_such_number_is_shown_in_one_line(value, shown):
    message = message_of(ValueError, check_number, "a", value, lambda x: x > 0, "a number > 0")
    assert message == f"a: need a number > 0, got {shown}"


def test_vectors_are_copies_in_float64():
    given = np.array([1.0, 2.0, 3.0])
    vector = check_vector("a", given)
    given[0] = 9
    assert vector.tolist() == [1, 2, 3] and vector.dtype == np.float64
    assert check_vector("a", (0, 0, 0)).tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    "value", [(0, 0), 1, "abc", None, (0, np.nan, 0), [[1], [1, 2]], (1, 2, 1j)]
)
def test_what_is_no_vector_is_refused(value):
    message = message_of(ValueError, check_vector, "a", value)
    assert message.startswith("a: need 3 finite numbers, got ")


def test_a_vector_of_no_length_is_refused_where_a_direction_is_wanted():
    message = message_of(ValueError, check_vector, "a", (0, 0, 0), True)
    assert message == "a: need a vector of nonzero length, got (0, 0, 0)"


@pytest.mark.parametrize("value", [0.5, [0.5], np.float32(0.5), (0.5, 0.5, 0.5)])
def test_a_single_number_stands_for_three_channels(value):
    color = check_color("a", value)
    assert color.tolist() == [0.5] * 3 and color.dtype == np.float32 and color.flags.writeable


@pytest.mark.parametrize(
    "value, largest, wanted",
    [
        ("red", np.inf, "a number or 3 numbers"),
        (None, np.inf, "values finite and >= 0"),
        ((1, 2), np.inf, "a number or 3 numbers"),
        (np.ones((1, 3)), np.inf, "a number or 3 numbers"),
        (-0.1, np.inf, "values finite and >= 0"),
        (1e39, np.inf, "values finite and >= 0"),
        ((0, np.nan, 0), 1.0, "values from 0 to 1"),
        ((0, 1.5, 0), 1.0, "values from 0 to 1"),
    ],
)
def test_what_is_no_color_is_refused(value, largest, wanted):
    message = message_of(ValueError, check_color, "a", value, largest)
    assert message.startswith(f"a: need {wanted}, got ")


def test_sizes():
    assert check_size(np.array([640, 480])) == (640, 480)
    assert check_size((1, np.uint8(255))) == (1, 255)


@pytest.mark.parametrize(
    "value", [(0, 4), (4,), (4.0, 4.0), (True, True), "4x4", 4, None, [[1], 2]]
)
def test_what_is_no_size_is_refused(value):
    message = message_of(ValueError, check_size, value)
    assert message == f"size: need (width, height), positive integers, got {value!r}"
