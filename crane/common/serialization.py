"""Serialization of numbers, texts, arrays, and objects of classes that the reader names.

The bytes contain data only: unlike a pickle they cannot name code to run, and arrays have numpy's
own types. The format is

    8 bytes: length of the head | head: JSON | elements of all arrays, concatenated

The head contains type, shape and position of an array, and the items of tuples and objects.
"""

import json
from collections.abc import Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

_HEAD_LENGTH_SIZE = 8  # bytes
_ARRAY_KINDS = "biufSU"  # no object arrays


def serialize(value: Any, classes: Sequence[type] = ()) -> bytes:
    """Serialize a value: equal bytes for equal values, to the last bit of every number.

    Args:
        value: None, a bool, int, float, str, bytes, array, dataclass, or a tuple of these.
        classes: Other classes that may occur; their attributes are serialized.

    Raises:
        TypeError: Another type, which may not be the same in another process.
    """
    blob = bytearray()

    def plain(value: Any) -> Any:
        if value is None or type(value) in (bool, int, float, str):
            return value
        if isinstance(value, bytes):
            blob.extend(value)
            return {"bytes": [len(blob) - len(value), len(value)]}
        if isinstance(value, tuple):
            return [plain(item) for item in value]
        if isinstance(value, np.ndarray | np.generic) and value.dtype.kind in _ARRAY_KINDS:
            start = len(blob)
            blob.extend(value.tobytes())
            return {"array": [value.dtype.str, list(value.shape), start]}
        if isinstance(value, tuple(classes)):
            state = vars(value)
        elif is_dataclass(value) and not isinstance(value, type):
            state = {field.name: getattr(value, field.name) for field in fields(value)}
        else:
            raise TypeError(f"a {type(value).__name__} cannot be written as data")
        return {"of": type(value).__qualname__, "state": {k: plain(v) for k, v in state.items()}}

    head = json.dumps(plain(value)).encode()
    return len(head).to_bytes(_HEAD_LENGTH_SIZE, "little") + head + bytes(blob)


def deserialize(data: bytes, classes: Sequence[type]) -> Any:
    """The value of `serialize`d bytes.

    Args:
        data: From `serialize`.
        classes: Classes that may occur, dataclasses included.

    Raises:
        ValueError: Not such bytes.
        KeyError: An object of another class.
    """
    start = _HEAD_LENGTH_SIZE + int.from_bytes(data[:_HEAD_LENGTH_SIZE], "little")
    named = {item.__qualname__: item for item in classes}

    def value_of(plain: Any) -> Any:
        if isinstance(plain, list):
            return tuple(map(value_of, plain))
        if not isinstance(plain, dict):
            return plain
        if "bytes" in plain:
            offset, count = plain["bytes"]
            return data[start + offset : start + offset + count]
        if "array" in plain:
            kind, shape, offset = plain["array"]
            count = int(np.prod(shape, dtype=np.intp))
            found = np.frombuffer(data, np.dtype(kind), count, start + offset).copy()
            return found.reshape(shape)[()]
        out: Any = object.__new__(named[plain["of"]])
        vars(out).update({key: value_of(x) for key, x in plain["state"].items()})
        return out

    return value_of(json.loads(data[_HEAD_LENGTH_SIZE:start]))
