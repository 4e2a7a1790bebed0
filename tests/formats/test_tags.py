import io
import json

import pytest

from skills.demonstration.recording import Label
from skills.errors import UnreadableRecording
from skills.formats import read_recording, write_mcap
from skills.formats.tags import read_labels
from skills.formats.upload import find_bag
from tests.formats.bags import recording
from tests.formats.others import zipped

T = 1_760_000_000_000_000_000
FRAMES = [T + k * 33_333_333 for k in range(100)]


def labels(**documents):
    return read_labels({f"{name}.json": json.dumps(document) for name, document in documents.items()})[0]


def stage(start, end, name="A1"):
    return {"stages": [{"name": name, "start": start, "end": end}]}


def test_the_newer_recorder_gives_moments():
    end = {"cpu_ts": T + 9, "frame_relative": 1, "frame_absolute": 2, "generated_at": "x"}
    document = {"type": "dvrk_data:video_tags@1.0.0", **stage({"cpu_ts": T + 5, "frame_absolute": 1}, end)}
    assert labels(stereo_tags=document) == (Label("A1", "stage", T + 5, T + 9),)


@pytest.mark.parametrize(
    "sidecar",
    [
        {"video_file": "left.mp4", "timestamps_ns": FRAMES},
        {"type": "dc::sidecar@1.0.0", "frames": [{"cpu_ts": moment, "gst_ts": 0} for moment in FRAMES]},
    ],
)
@pytest.mark.parametrize("frame", [lambda k: k, lambda k: {"frame_idx": k}, lambda k: {"frame_absolute": k}])
def test_the_older_recorder_gives_frames_of_a_video(sidecar, frame):
    tags = {"video_file": "left.mp4", **stage(frame(3), frame(8))}
    assert labels(left_tags=tags, left=sidecar) == (Label("A1", "stage", FRAMES[3], FRAMES[8]),)


def test_frames_of_a_video_without_its_sidecar_have_no_time():
    assert labels(left_tags=stage(3, 8)) == ()
    assert labels(left_tags=stage(3, 800), left={"timestamps_ns": FRAMES}) == ()


def test_a_stage_that_never_ended_is_passed_over():
    assert labels(session={"stages": [{"name": "A1", "start": {"cpu_ts": T}}]}) == ()


def test_a_stage_named_in_two_files_is_one_and_they_are_in_order_of_time():
    late, early = (
        stage({"cpu_ts": T + 50}, {"cpu_ts": T + 60}, "late"),
        stage({"cpu_ts": T}, {"cpu_ts": T + 9}, "early"),
    )
    assert [label.name for label in labels(a=late, b=early, c=late)] == ["early", "late"]


def test_other_json_is_no_concern():
    assert labels(index={"videos": [{"file": "a", "duration": 1}]}, list=[1, 2], number=3) == ()


@pytest.mark.parametrize(
    ("document", "message"),
    [
        ({"stages": {"A1": 1}}, "not a list"),
        ({"stages": [["A1"]]}, "without a name"),
        ({"stages": [{"name": 1, "start": T, "end": T}]}, "without a name"),
        (stage({"cpu_ts": T + 9}, {"cpu_ts": T}), "before it starts"),
    ],
)
def test_tags_that_cannot_be_meant_are_refused(document, message):
    with pytest.raises(UnreadableRecording, match=message):
        labels(tags=document)


def test_a_name_that_cannot_be_shown_is_mended():
    odd = stage({"cpu_ts": T}, {"cpu_ts": T}, "A1 \ud800\x00é" + "x" * 500)
    (label,) = labels(tags=odd)
    assert label.name == ("A1 ??é" + "x" * 500)[:200]


def test_what_is_no_json_is_refused_by_name():
    for name, text in (("x_tags", "{"), ("x_left", '{"timestamps_ns": [1, 2')):
        with pytest.raises(UnreadableRecording, match=name):
            read_labels({f"s/{name}.json": text})


@pytest.mark.parametrize(
    "text", ['{\n  // which arms\n  "arms": ["PSM1"],\n}', "", "\x00\xff", "[1, 2", "arms: [PSM1]"]
)
def test_other_json_with_comments_or_damage_is_left_aside_and_named(text, tmp_path):
    tags = json.dumps(stage({"cpu_ts": T}, {"cpu_ts": T}))
    found, left_aside = read_labels({"s/arms.json": text, "s/x_tags.json": tags})
    assert len(found) == 1
    assert list(left_aside) == ["arms.json"]
    members = {"s/b.mcap": write_mcap(recording()), "s/arms.json": text.encode("latin-1")}
    got = read_recording(io.BytesIO(zipped(members)))
    assert dict(got.left_out)["arms.json"].startswith("left aside")
    for name, data in members.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(data)
    assert find_bag(tmp_path / "s").left_aside == ("arms.json",)


UNRELATED = {
    "settings.json": '{\n  // of an editor\n  "frames": 30, "stages": ["build"]\n}',
    "pipeline.json": '{"stages": ["build", "test"]}',
    "plan.json": '{"stages": {"one": 1}, "frames": 3}',
    "people.json": '{"stages": [{"title": "novice"}]}',
    "half.json": '{"video_file": "left.mp4", ',
}


@pytest.mark.parametrize("name", UNRELATED)
def test_somebodys_own_json_beside_a_bag_is_left_aside_and_stays(name, skills, tmp_path, monkeypatch):
    (tmp_path / "b.mcap").write_bytes(write_mcap(recording()))
    (tmp_path / name).write_text(UNRELATED[name])
    monkeypatch.chdir(tmp_path)
    said = skills.does("recording", "preview", ".")
    assert f"{name} has no tags of a recorder: left aside." in said
    assert "remove" not in said.lower()
