"""The text of tables: Arrow's parser and Python's say the same, and a last row that may be cut is noticed."""

import io
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skills.errors import NotFinite, SkillsError, UnreadableRecording
from skills.formats import cells, read_recording
from skills.formats.cells import NS_PER, header_of, open_text
from tests.formats import written

MAPPED = {"column": ["x=PosX", "y=PosY", "z=PosZ"], "unit": ["mm"], "frame": "base", "rate_hz": 100.0}
NUMBERS = st.floats(allow_nan=False, allow_infinity=False).map(repr)
TEXTS = st.sampled_from(
    [
        *("", " 1.5", "1.5 ", "+1", "-0", ".5", "5.", "1e5", "1E-5", "1e-999", "4.9e-324", "nan", "inf", "1e999"),
        *("0x1", "1_0", "1.2.3", '"1"', "np.float64(1.5)", "np.float64(1", "\u0661", "1" * 400, "\0", "1\r"),
        *("0." + 400 * "7", "9007199254740993", "2.2250738585072011e-308", "1760000000.123456789", "0.1000000005"),
        *("1e-99999999999", "1e99999999999", "9" * 25, "-5", "4000000000"),
    ]
)
ROWS = st.lists(st.lists(NUMBERS | TEXTS, min_size=3, max_size=3), min_size=1, max_size=6)


def both(text, used=(0, 1, 2), decimal="point", time=None):
    """Return what the quick and the thorough parser say: values and stamps, or None and the refusal."""
    said, groups = [], [[k] for k in used]
    for quickly in (True, False):
        with open_text(io.BytesIO(text.encode())) as opened:
            names, separator = header_of(opened)
            layout = cells.TableLayout(names, groups, separator, decimal, time)
            try:
                numbers = cells._plain_numbers(opened.buffer, layout) if quickly else cells._any_numbers(opened, layout)
            except SkillsError as refused:
                numbers = type(refused)
        said.append(numbers)
    return said


def whole(numbers):
    return np.concatenate(numbers.groups, axis=1)


def assert_equal(one, other):
    np.testing.assert_array_equal(whole(one).view(np.int64), whole(other).view(np.int64))  # -0.0 as well
    if one.stamps_ns is not None or other.stamps_ns is not None:
        np.testing.assert_array_equal(one.stamps_ns, other.stamps_ns)


@given(rows=ROWS, unit=st.sampled_from([None, *NS_PER]), end=st.sampled_from(["\n", "\r\n", "\n\n", ""]))
def test_both_parsers_read_the_same_numbers_to_the_last_bit(rows, unit, end):
    text = "a,b,c\n" + "\n".join(map(",".join, rows)) + end
    quick, thorough = both(text, time=None if unit is None else (0, unit))
    if quick is None or not np.isfinite(whole(quick)).all():  # otherwise refused as not finite
        return
    early = True if unit is None else bool((np.abs(whole(quick)[:, 0]) < 4e9 * (1e9 // NS_PER[unit])).all())
    if early:  # otherwise refused as after the year 2096
        assert_equal(quick, thorough)


SOUND = {
    "ee_csv": (written.ee_csv(rows=50), "point", (0, "ns")),
    "ee_csv of numpy's texts": (written.ee_csv(rows=50, numpy=True), "point", (0, "ns")),
    "semicolons": (written.positions(), "point", None),
    "decimal commas": (written.positions(comma=True), "comma", None),
    "tabs": (written.positions(separator="\t"), "point", None),
    "spaces": (written.positions(separator=",").replace(",", " , "), "point", None),
    "carriage returns": (written.positions().replace("\n", "\r\n"), "point", None),
    "a byte order mark": ("\ufeff" + written.positions(), "point", None),
    "no last line end": (written.positions()[:-1], "point", None),
    "empty lines at the end": (written.positions() + "\n\n", "point", None),
    "words in other letters": ("x;\u00fc\n1.5;\u00e4\n2.5;\u00f6\n", "point", None),
}


@pytest.mark.parametrize("name", SOUND)
@pytest.mark.parametrize("block_bytes", [4 << 20, 4096])
def test_sound_tables_are_read_quickly_in_blocks_of_any_size(name, block_bytes, monkeypatch):
    monkeypatch.setattr(cells, "BLOCK_BYTES", block_bytes)
    text, decimal, time = SOUND[name]
    quick, thorough = both(text, (0,) if time is None else (0, 1, 2), decimal, time)
    assert quick is not None
    assert_equal(quick, thorough)


def test_a_nan_in_a_later_block_is_refused_with_its_row(monkeypatch):
    monkeypatch.setattr(cells, "BLOCK_BYTES", 4096)
    lines = ["t_s,x_mm,y_mm,z_mm", *(f"{k},1.5,2.5,3.5" for k in range(2000))]
    lines[1500] = "1499,1.5,nan,3.5"
    with pytest.raises(NotFinite, match="Row 1501, column y_mm"):
        read_recording(io.BytesIO("\n".join([*lines, ""]).encode()))


@pytest.mark.parametrize(
    "rows", ["1,2\n\n3,4\n", '1,"2"\n', "1\n2,3,4\n", "1,2\n" + 20_000 * " " + "1,2\n", "1,2\r3,4\r"]
)
def test_other_tables_are_left_to_the_thorough_parser(rows):
    assert both("a,b\n" + rows, (0, 1))[0] is None


@pytest.mark.parametrize("end", ["\r", "\r\r\n"])
def test_a_row_below_a_header_with_another_line_end_is_not_lost(end):
    quick, thorough = both(f"a,b{end}1,2\n3,4\n", (0, 1))
    assert quick is None
    assert isinstance(thorough, type) or whole(thorough).tolist() == [[1, 2], [3, 4]]


def test_the_quick_parser_starts_no_threads():
    """A reader's process may start none; Arrow's own reader of CSV files would."""
    code = (
        "import io, os, pyarrow\n"
        "from skills.formats.cells import TableLayout, _plain_numbers\n"
        "before = len(os.listdir('/proc/self/task'))\n"
        "layout = TableLayout(['t', 'x'], ([0], [1]), time=(0, 's'))\n"
        "read = _plain_numbers(io.BytesIO(b't,x\\n' + 1000 * b'1.5, 2.5\\n'), layout)\n"
        "assert read.rows == 1000\n"
        "print(len(os.listdir('/proc/self/task')) - before)\n"
    )
    env = os.environ | {"OPENBLAS_NUM_THREADS": "1"}
    assert subprocess.run([sys.executable, "-c", code], env=env, check=True, capture_output=True).stdout == b"0\n"


# ---- the last row ------------------------------------------------------------------------------------------------


def mapped(text):
    return read_recording(io.BytesIO(text.encode()), **MAPPED)


def test_a_table_without_a_last_line_end_is_read_with_a_note():
    text = written.positions()
    whole, open_ended = mapped(text), mapped(text[:-1])
    assert whole.notes == ()
    assert dict(open_ended.notes) == {
        "last row": "It has no line end: if the file was cut, its last number lacks digits."
    }
    np.testing.assert_array_equal(open_ended.motion_of().tip_mm, whole.motion_of().tip_mm)


@pytest.mark.parametrize("cut", [1, 2, 3, 4, 5])
def test_a_last_number_that_lost_decimals_is_refused(cut):
    text = written.positions()
    with pytest.raises(UnreadableRecording, match=f"has {max(0, 4 - cut)} decimals where all others have 4"):
        mapped(text[: -1 - cut])


def test_a_last_number_is_compared_only_with_rows_that_agree():
    rows = "".join(f"0;50;{-120 - k / 8}\n" for k in range(40))  # of one to three decimals
    assert mapped("PosX;PosY;PosZ\n" + rows + "0;50;-125").notes
    few = "".join(f"0;50;{-120 - k}.2500\n" for k in range(9))
    assert mapped("PosX;PosY;PosZ\n" + few + "0;50;-130.2").notes


def test_a_cut_extract_is_refused():
    text = "# Topic: /PSM1/local/measured_cp\n# Type: geometry_msgs/msg/PoseStamped\na,b\n1,2"
    with pytest.raises(UnreadableRecording, match="the file was cut"):
        read_recording(io.BytesIO(text.encode()))
