"""Arrays of values: copied unless nobody else can change them."""

import numpy as np
import pytest

from skills.arrays import frozen


def test_an_array_that_can_change_is_copied():
    values = np.arange(6.0).reshape(2, 3)
    kept = frozen(values, np.float64, (None, 3), "values")
    values[0, 0] = 9.0
    assert kept[0, 0] == 0.0
    assert not kept.flags.writeable


def test_an_array_that_is_frozen_already_is_not_copied():
    first = frozen([[1.0, 2.0, 3.0]], np.float64, (None, 3), "values")
    assert frozen(first, np.float64, (1, 3), "values") is first


@pytest.mark.parametrize("part", [np.s_[:], np.s_[:, :2], np.s_[::2]])
def test_a_read_only_view_of_an_array_that_can_change_is_copied(part):
    values = np.arange(12.0).reshape(4, 3)
    view = values[part]
    view.setflags(write=False)
    kept = frozen(view, np.float64, (None, None), "values")
    values[0, 0] = 9.0
    assert kept[0, 0] == 0.0


def test_frozen_arrays_of_another_type_or_order_are_converted():
    single = np.ones((2, 3), np.float32)
    columns = np.asfortranarray(np.ones((2, 3)))
    for values in (single, columns):
        values.setflags(write=False)
        kept = frozen(values, np.float64, (2, 3), "values")
        assert (kept.dtype, kept.flags.c_contiguous) == (np.float64, True)


def test_a_negative_zero_is_zero_so_that_equal_numbers_have_equal_digests() -> None:
    assert not np.signbit(frozen([-0.0, 1.0], np.float64, (2,), "numbers")).any()
