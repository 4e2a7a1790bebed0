"""Inputs made after public bug reports: every one is read right, or refused or asked about by its cause."""

import os
from pathlib import Path

from tests.formats.cases import listed, outcome
from tests.needs import need

# What must be said of each; a table of all is printed by `python -m tests.formats.cases FOLDER`.
WHOLE, EPISODE = "900 poses in 8.99 s, 100 Hz", "200 poses in 6.63 s, 30 Hz"
NOW = {
    "50-db3-with-wal-zip": f"{WHOLE}, full",
    "50-db3-without-its-wal": "is in WAL mode",
    "33-csv-s-named-ms-100hz": "In s they would give 100 poses per second",
    "33-csv-ms-named-s": "In ms they would give 100 poses per second",
    "33-csv-ns-named-us": "In ns they would give 100 poses per second",
    "37-csv-euler-degrees-named-rad": "Are they in degrees?",
    "37-csv-jaw-degrees-named-rad": "Is it in degrees?",
    "09-first-stamp-zero-one-sample": "the clock was not set in 1 sample",
    "40-lerobot-timestamp-ms-double": "and 0.0333333 s by the fps of 30",
    "19-teleport-30mm": "jumps by 30.1 mm within 10 ms at 4.990 s, at 3014 mm/s",
    "35-csv-one-row": "one sample",
    "15-one-sample": "one sample",
    "07-split-latched-repeated-zip": "/console/clutch: 1 dropped",
    "06-split-boundary-out-of-order-20ms-zip": WHOLE,
    "06-split-boundary-out-of-order-20ms-folder": WHOLE,
    "56-ros1-dvrk17-jaw": f"{WHOLE}, none; jaws 1",
    "58-session-with-dvrk-config-comments-zip": WHOLE,
    "22-mcap-of-ros1-bag": "Send the .bag",
    "23-lfs-pointer": "git lfs pull",
    "42-lerobot-lfs-pointer": "git lfs pull",
    "42-lerobot-no-footer": "before it closed the file",
    "43-lerobot-v3-gap": "60 poses in 1.97 s",
    "44-lerobot-names-index-dict": EPISODE,
    "44-lerobot-names-two-groups": EPISODE,
    "55-db3-compressed-per-message-zip": "ros2 bag convert",
    "56-ros1-bag-active-unindexed": "rosbag reindex",
    "34-csv-excel-exponent-epoch": "has lost its last digits",
    "34-csv-iso-times": WHOLE,
    "59-ee-csv-pandas-float": "has lost its last digits",
    "08-header-stamp-zero": "stamps: the time of reception",
    "31-csv-excel-sep-line": WHOLE,
    "31-csv-pandas-index": WHOLE,
    "31-csv-trailing-separator-rows-only": WHOLE,
    "31-csv-numpy-hash-header": WHOLE,
    "30-csv-utf16-excel-unicode": WHOLE,
    "30-csv-cp1252-degree": "iconv -f WINDOWS-1252",
    "51-mcap-uppercase-suffix-zip": WHOLE,
}


def test_every_case_is_read_right_or_named_by_its_cause():
    need("cases")
    folder = Path(os.environ["SKILLS_TEST_CASES"])
    assert set(listed(folder)) == set(NOW)
    said = {name: outcome(folder / name) for name in NOW}
    assert {name: one for name, one in said.items() if NOW[name] not in one} == {}
