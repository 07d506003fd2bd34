"""Serialized values: same value from the bytes, same bytes from equal values."""

from dataclasses import dataclass

import numpy as np
import pytest

from crane.common.serialization import deserialize, serialize


@dataclass(frozen=True)
class Frozen:
    a: float
    b: tuple[int, ...]


class Plain:
    def __init__(self, x):
        self.x = x


VALUES = [
    None, True, False, 0, 1, -(2**70), 0.1, -0.0, float("inf"), "", "é\0", b"", b"\0a\0", (),
    (1, (2.0, b"x"), None), np.zeros((0, 3)), np.arange(6).reshape(2, 3)[:, ::-1],
    np.array([0.1, np.nan, -0.0]), np.array([True]), np.array(["a", "bc"]), np.intp(4),
    np.float32(0.1), np.array(3.0), Frozen(0.1, (1, 2)), Plain(np.eye(2)), Plain(Frozen(1.0, ())),
]  # fmt: skip


@pytest.mark.parametrize("value", VALUES)
def test_a_value_comes_back(value):
    data = serialize(value, (Plain,))
    back = deserialize(data, (Plain, Frozen))
    assert serialize(back, (Plain,)) == data
    if isinstance(value, np.ndarray) and value.shape:
        np.testing.assert_array_equal(back, value)
        assert back.dtype is np.dtype(value.dtype.str) or value.dtype.kind == "U"
        back[...] = back[::-1]  # an array of its own
    elif not isinstance(value, Plain):
        assert back == value and type(back) in (type(value), np.float64)


def test_values_that_differ_have_other_bytes():
    assert len({serialize(value, (Plain,)) for value in VALUES}) == len(VALUES)


@pytest.mark.parametrize("value", [object(), [1], {1: 2}, {1}, len, np.array([None]), Plain(1)])
def test_what_is_no_data_is_refused(value):
    with pytest.raises(TypeError, match="cannot be written as data"):
        serialize(value)


def test_an_object_of_a_class_that_is_not_named_is_refused():
    with pytest.raises(KeyError):
        deserialize(serialize(Frozen(0.0, ())), (Plain,))
