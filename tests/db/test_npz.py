"""Archives of arrays: numpy reads ours, we read numpy's, and what is no such archive is nobody's."""

import io
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as some

from skills.db import npz

ARRAYS = st.dictionaries(
    st.text("abc_", min_size=1, max_size=5),
    some.arrays(
        st.sampled_from([np.float64, np.float32, np.int64, np.int8, np.uint8, np.bool_, np.complex128]),
        some.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=40),
    ),
    max_size=4,
)


def written(arrays: npz.Arrays, save=npz.save) -> bytes:
    out = io.BytesIO()
    save(out, **arrays)
    return out.getvalue()


def assert_same(one: npz.Arrays, other: npz.Arrays) -> None:
    assert list(one) == list(other)
    for name, array in one.items():
        assert (array.dtype, array.shape) == (other[name].dtype, other[name].shape)
        assert array.tobytes() == other[name].tobytes()


@given(ARRAYS)
def test_numpy_reads_what_we_write_and_we_read_both(arrays: npz.Arrays):
    data = written(arrays)
    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        assert_same(dict(archive), arrays)
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
    for save in (npz.save, np.savez, np.savez_compressed):
        assert_same(npz.load(written(arrays, save)), arrays)


@given(ARRAYS)
def test_how_an_array_lies_in_memory_is_not_seen(arrays: npz.Arrays):
    turned = {name: np.asarray(array, order="F") for name, array in arrays.items()}
    assert written(turned) == written(arrays)
    assert_same(npz.load(written(turned, np.savez)), arrays)


def test_plain_arrays_are_read_without_numpy_and_without_a_copy():
    arrays = {"a": np.arange(30.0).reshape(5, 6), "b": np.zeros((0, 3), np.int8), "c": np.array(True)}
    for save in (npz.save, np.savez, np.savez_compressed):
        for array in dict(npz._members(written(arrays, save))).values():
            assert not array.flags.owndata and not array.flags.writeable


def test_large_archives_are_left_to_numpy(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(npz, "MAX_BYTES", 8)
    arrays = {"a": np.arange(3.0)}
    assert written(arrays) == written(arrays, np.savez_compressed)


@pytest.mark.parametrize("seed", range(3))
def test_a_damaged_archive_is_read_as_it_was_or_refused(seed: int):
    arrays = {"a": np.arange(50.0), "b": np.arange(9)}
    data, rng = written(arrays), np.random.default_rng(seed)
    for bit in rng.integers(0, 8 * len(data), 200).tolist():
        flipped = bytearray(data)
        flipped[bit // 8] ^= 1 << bit % 8
        try:
            read = npz.load(bytes(flipped))
        except Exception:
            continue
        for name, array in read.items():
            if name in arrays:
                assert array.tobytes() == arrays[name].tobytes() or array.dtype != arrays[name].dtype


def test_an_array_of_objects_is_neither_written_nor_read():
    objects = {"a": np.array([{}], dtype=object)}
    with pytest.raises(TypeError):
        written(objects)
    with pytest.raises(ValueError, match="allow_pickle=False"):
        npz.load(written(objects, np.savez))


@pytest.mark.parametrize("data", [b"", b"PK", b"x" * 100, b"PK\5\6" + bytes(18)[:-1]])
def test_what_is_no_archive_is_refused(data: bytes):
    with pytest.raises(Exception):  # noqa: B017, PT011 - of any class
        npz.load(data)["a"]
