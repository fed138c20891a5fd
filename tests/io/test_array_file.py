"""Files of arrays: the format is that of safetensors, and a file that lies is one message."""

import json

import numpy as np
import pytest
from safetensors.numpy import load

from radiotwin.errors import BadInput
from radiotwin.io.array_file import pack_arrays, parse_arrays

ARRAYS = {"a": np.arange(6, dtype=np.int16).reshape(2, 3), "b": np.array([True, False]), "c": np.zeros((0, 4)),
          "d": np.array(2.5, np.float32)}


def with_header(header, content=b"\0" * 8):
    encoded = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(encoded).to_bytes(8, "little") + encoded + content


def test_arrays_come_back_as_the_library_of_the_format_reads_them():
    data = pack_arrays(ARRAYS, "text", "hello")
    (found, text), other = parse_arrays(data, "text", "it"), load(data)
    assert text == "hello" and found.keys() == other.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert found[name].dtype == array.dtype and found[name].shape == array.shape
        np.testing.assert_array_equal(found[name], array)
        np.testing.assert_array_equal(other[name], array)


def one(dtype="F64", shape=(1,), offsets=(0, 8)):
    return {"__metadata__": {"text": ""}, "x": {"dtype": dtype, "shape": shape, "data_offsets": offsets}}


HOSTILE = {
    "nothing": b"", "short": b"123", "a header of 2^63 bytes": (2**63).to_bytes(8, "little") + b"{}",
    "no JSON": with_header(b"{"), "not UTF-8": with_header(b"\xff\xfe"), "a list": with_header([]),
    "deep": with_header(b"[" * 100_000), "no text": with_header({"x": one()["x"]}),
    "another text": with_header(one() | {"__metadata__": {"text": 3}}), "a type": with_header(one("F128")),
    "a type that is a list": with_header(one(["F64"])), "huge": with_header(one(shape=[10**12])),
    "huge product": with_header(one("U8", [2**31, 2**31, 0], [0, 0])), "negative": with_header(one(shape=[-1])),
    "a side that is true": with_header(one(shape=[True])), "dimensions": with_header(one(shape=[1] * 100)),
    "before": with_header(one(offsets=[-8, 0])), "beyond": with_header(one(offsets=[8, 16])),
    "bytes left": with_header(one(), b"\0" * 9),
    "overlapping": with_header(one() | {"y": one()["x"]}), "no boolean": with_header(one("BOOL", [8]), b"\2" * 8),
    "many digits": with_header(b'{"x": {"shape": [' + b"9" * 5000 + b"]}}")}


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE)
def test_a_file_that_lies_is_one_message(data):
    with pytest.raises(BadInput, match="it"):
        parse_arrays(data, "text", "it")
    assert parse_arrays(with_header(one()), "text", "it")[0]["x"].shape == (1,)
