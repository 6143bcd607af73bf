from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from protocol import arrays
from protocol.codec import Format
from protocol.errors import BadShape, OutOfRange
from protocol.features import Feature, FeatureTable
from tests.protocol.golden import TABLE

bit_matrices = hnp.arrays(np.bool_, st.tuples(st.integers(1, 5), st.integers(1, 20)))


@given(bit_matrices, st.sampled_from(Format))
def test_bits_survive_the_wire(matrix: np.ndarray, form: Format) -> None:
    assert np.array_equal(arrays.bits(arrays.pack_bits(matrix, form), matrix.shape, "x"), matrix)


@given(bit_matrices)
def test_feature_i_is_bit_i_mod_8_of_byte_i_div_8(matrix: np.ndarray) -> None:
    packed = arrays.pack_bits(matrix, Format.MSGPACK)
    row_bytes = -(-matrix.shape[1] // 8)
    for n, i in np.ndindex(*matrix.shape):
        assert bool(packed[n * row_bytes + i // 8] >> (i % 8) & 1) == matrix[n, i]


finite32 = st.floats(width=32, allow_nan=False, allow_infinity=False)


@given(
    hnp.arrays(np.float32, st.tuples(st.integers(1, 4), st.integers(0, 4)), elements=finite32), st.sampled_from(Format)
)
def test_floats_survive_the_wire(matrix: np.ndarray, form: Format) -> None:
    back = arrays.floats(arrays.pack_floats(matrix, form), matrix.shape, "x")
    assert back.dtype == np.float32
    assert np.array_equal(back, matrix)


@settings(deadline=None)
@given(st.data())
def test_values_survive_the_wire(data: st.DataObject) -> None:
    n = data.draw(st.integers(1, 4))
    acquired = data.draw(hnp.arrays(np.bool_, (n, TABLE.n_queries)))
    costly = data.draw(hnp.arrays(np.float32, (n, TABLE.n_costly), elements=st.floats(0, 50, width=32)))
    packed = costly[np.repeat(acquired, TABLE.sizes, axis=1)].astype("<f4").tobytes()
    expected = np.where(acquired[:, TABLE.owner], costly, 0)
    assert np.array_equal(arrays.unpack_values(packed, acquired, TABLE), expected)
    rows = [row[mask].tolist() for row, mask in zip(costly, acquired[:, TABLE.owner], strict=True)]
    assert np.array_equal(arrays.unpack_values(rows, acquired, TABLE), expected)


@pytest.mark.parametrize(
    "blob", [b"", b"\0" * 20, b"\0" * 28, [[1.0, 2.0, 3.0]], [[1.0] * 3] * 3, [[1.0] * 3, [1.0] * 4]]
)
def test_floats_of_another_shape_are_refused_by_name(blob: bytes | list[list[float]]) -> None:
    with pytest.raises(BadShape, match="speeds"):
        arrays.floats(blob, (2, 3), "speeds")


@pytest.mark.parametrize("blob", [b"", b"\0\0\0", b"\0" * 5, [[0] * 10], [[0] * 9, [0] * 10], b"\0\x04\0\0"])
def test_bits_of_another_shape_are_refused_by_name(blob: bytes | list[list[int]]) -> None:
    with pytest.raises(BadShape, match="acquired"):
        arrays.bits(blob, (2, 10), "acquired")


def test_what_is_no_number_is_left_to_the_bots_to_refuse() -> None:
    (signalling,) = struct.unpack("<d", bytes.fromhex("010000000000f07f"))  # numpy warns where it casts this one
    for nan in (float("nan"), signalling):
        assert np.isnan(arrays.floats([[nan]], (1, 1), "free")).all()
    assert np.isinf(arrays.floats([[float("inf")]], (1, 1), "free")).all()


def test_a_number_too_large_for_float32_is_out_of_range() -> None:
    with pytest.raises(OutOfRange):
        arrays.floats([[1e300]], (1, 1), "free")


def test_what_was_not_acquired_is_zero() -> None:
    table = FeatureTable((Feature("far", 1, cost_us=1.0, low=10.0, high=20.0),))
    assert arrays.unpack_values(b"", np.zeros((3, 1), dtype=bool), table).tolist() == [[0.0]] * 3


@pytest.mark.parametrize("values", [b"", b"\0" * 12, [[1.0, 2.0]], [[], [1.0, 2.0]], [[1.0], [1.0]]])
def test_more_or_fewer_values_than_acquired_are_refused(values: bytes | list[list[float]]) -> None:
    acquired = np.zeros((2, TABLE.n_queries), dtype=bool)
    acquired[0, 0] = True  # two numbers, for the first bot
    with pytest.raises(BadShape, match="values"):
        arrays.unpack_values(values, acquired, TABLE)
