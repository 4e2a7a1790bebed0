import io
import tomllib
from importlib.resources import files

import numpy as np
import pytest

from skills.demonstration.demonstration import cut_demo
from skills.demonstration.segments import propose_segments
from skills.formats import read_recording
from skills.seeds.recordings import sample_recordings

ORIGIN_MM, CELL_MM, SHAPE = np.array([-30.0, 25.0, -140.0]), 5.0, 11  # the paper's grid
SLUGS = [
    "simple-interrupted",
    "simple-running",
    "running-locked",
    "horizontal-mattress",
    "vertical-mattress",
    "half-buried-mattress",
    "figure-of-eight",
    "simple-buried",
    "running-subcuticular",
    "interrupted-subcuticular",
    "purse-string",
]


def catalogue(name):
    return tomllib.loads((files("skills.seeds") / name).read_text())


@pytest.fixture(params=sample_recordings(), ids=lambda sample: sample.name)
def sample(request):
    return request.param


def recording_of(sample):
    return read_recording(io.BytesIO(sample.data))


def states_of(demo):
    cells = np.rint((demo.tip_mm - ORIGIN_MM) / CELL_MM).astype(int)
    index = cells @ [SHAPE * SHAPE, SHAPE, 1]
    return index[np.concatenate(([True], np.diff(index) != 0))]


def test_the_catalogue_has_the_eleven_suture_types_of_the_interface():
    types = catalogue("suture_types.toml")["suture_type"]
    assert [one["slug"] for one in types] == SLUGS
    assert all({"name", "also_called", "family", "description"} <= one.keys() for one in types)


def test_every_sample_is_of_a_surgeon_and_a_suture_of_the_catalogue(sample):
    surgeons = {one["slug"]: one["skill_level"] for one in catalogue("surgeons.toml")["surgeon"]}
    assert len(surgeons) >= 4
    assert set(surgeons.values()) == {"novice", "intermediate", "expert"}
    assert sample.surgeon in surgeons
    assert sample.suture in SLUGS


def test_the_samples_are_the_same_bytes_each_time():
    again = sample_recordings.__wrapped__()
    assert [one.data for one in again] == [one.data for one in sample_recordings()]


def test_a_sample_says_what_a_dvrk_says(sample):
    recording = recording_of(sample)
    assert {topic.name for topic in recording.topics} == {
        "/PSM2/local/measured_cp",
        "/PSM2/jaw/measured_js",
        "/console/clutch",
    }
    assert recording.integrity == "full"
    assert recording.motion_of().frame == "PSM2_base"
    step_s = np.median(np.diff(recording.motion_of().stamps_ns)) / 1e9
    assert 0.0049 <= step_s <= 0.0101, "100 to 200 Hz with the jitter of a recorder"


def test_a_sample_stays_inside_the_papers_grid(sample):
    cells = (recording_of(sample).motion_of().tip_mm - ORIGIN_MM) / CELL_MM
    assert cells.min() > -0.5
    assert cells.max() < SHAPE - 0.5


def test_the_tool_points_down_and_hardly_turns(sample):
    rotation = recording_of(sample).motion_of().rotation_xyzw
    down = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0])
    assert np.degrees(2 * np.arccos(np.abs(rotation @ down).min())) < 3.0


def test_every_hand_off_is_found_where_it_is(sample):
    proposed = propose_segments(recording_of(sample), "PSM2")
    assert len(proposed) == len(sample.segments)
    for segment, (start_s, end_s) in zip(proposed, sample.segments, strict=True):
        assert segment.start_s == pytest.approx(start_s, abs=0.25)
        assert segment.end_s == pytest.approx(end_s, abs=0.25)


def test_a_hand_off_has_20_to_60_states_and_ends_elsewhere(sample):
    for start_s, end_s in sample.segments:
        states = states_of(cut_demo(recording_of(sample), start_s=start_s, end_s=end_s))
        assert 20 <= len(states) <= 60
        assert states[0] != states[-1]


def test_the_styles_differ():
    by_surgeon = {one.surgeon: one for one in sample_recordings() if one.suture == "simple-running"}
    demos = {
        surgeon: cut_demo(recording_of(one), start_s=one.segments[0][0], end_s=one.segments[0][1])
        for surgeon, one in by_surgeon.items()
    }
    highest = {surgeon: demo.tip_mm[:, 2].max() for surgeon, demo in demos.items()}
    assert max(highest, key=highest.get) == "heron"
    wren = states_of(demos["wren"])
    assert len(set(wren.tolist())) < len(wren), "the loop comes back to a state"
    assert demos["plover"].clutch_presses == 2
    assert [demos[surgeon].clutch_presses for surgeon in ("kestrel", "heron", "wren")] == [0, 0, 0]


def test_one_sample_has_five_hand_offs():
    assert sorted(len(one.segments) for one in sample_recordings()) == [1, 1, 1, 1, 5]
