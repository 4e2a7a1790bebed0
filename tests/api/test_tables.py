"""Tables over HTTP: what is said about them once, previewed, stored and read again; and counts of dropped samples."""

import io
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import func, select

from skills.db.models import StoredRecording
from skills.kinematics import forward, quaternion_of
from skills.schemas.recordings import TableIn
from tests.api.service import CSV, KESTREL, Service, assert_problem
from tests.formats import hostile, written
from tests.formats.bags import sample_folder
from tests.formats.test_tables_hostile import FILES, mutations

SAID = {"column": ["x=PosX", "y=PosY", "z=PosZ"], "unit": ["mm"], "frame": "base", "rate_hz": 100.0}
POSITIONS = written.positions().encode()


def send(service: Service, path: str, data: bytes, **query):
    return service.http.post(path, params=query, content=data, headers={"Content-Type": CSV})


def recordings(service: Service) -> int:
    with service.database.reading() as session:
        return session.scalar(select(func.count()).select_from(StoredRecording)) or 0


def test_a_preview_says_what_was_understood_and_stores_nothing(here: Service):
    seen = here.client.preview_recording(POSITIONS, **SAID | {"rate_hz": None})
    assert (seen["timed"], seen["duration_s"], seen["quality"][0]["rate_hz"], seen["segments"]) == (
        False,
        None,
        None,
        [],
    )
    assert [tuple(one.values()) for one in seen["columns"]] == [
        ("PosX", "x", "mm"),
        ("PosY", "y", "mm"),
        ("PosZ", "z", "mm"),
    ]
    timed = here.client.preview_recording(POSITIONS, **SAID | {"table_arm": "PSM2", "frame": "ECM"})
    assert (timed["timed"], timed["duration_s"]) == (True, pytest.approx(9.39))
    assert (timed["motions"][0]["arm"], timed["motions"][0]["frame"]) == ("PSM2", "ECM")
    assert recordings(here) == 0
    for said, question in ((SAID | {"unit": None}, "In which unit"), (SAID | {"column": None}, "unknown column")):
        refused = {name: value for name, value in said.items() if value is not None}
        assert question in assert_problem(send(here, "/recordings/preview", POSITIONS, **refused), 422)["detail"]
    assert recordings(here) == 0


def test_joints_beside_poses_say_which_instrument_it_was(here: Service):
    joints = np.loadtxt(io.StringIO(written.joints()), delimiter=",", skiprows=1)
    tip_mm, turned = forward(joints * [1, 1, 1000, 1, 1, 1], "400006")
    rows = np.column_stack([joints, tip_mm / 1000.0, quaternion_of(turned)])
    names = "q1_rad,q2_rad,q3_m,q4_rad,q5_rad,q6_rad,x_m,y_m,z_m,qx,qy,qz,qw"
    data = "\n".join([names, *(",".join(map(repr, row)) for row in rows.tolist())]).encode()
    stored = here.client.add_recording(data, rate_hz=30.0)
    (one,) = stored["identifications"]
    assert (one["found"]["verdict"], one["found"]["instrument"]) == ("identified", "400006")
    assert one["found"]["greatest_mm"] < 1e-6
    page = here.http.get(f"/pages/recordings/{stored['sha256']}").text
    assert "identified" in page and one["found"]["reason"] in page
    other = data + b"\n" + data.splitlines()[-1]  # other bytes: these are stored already, without an instrument
    said = {"rate_hz": 30.0, "instrument": "420006-Classic", "segment": "whole"}
    problem = assert_problem(send(here, "/demos", other, **KESTREL, **said), 422, "joints-disagree")
    assert "420006-Classic" in problem["detail"] and problem["numbers"]["residual_mm"] < 1e-6


@pytest.mark.parametrize(
    ("query", "where"),
    [
        ({"unit": "inch"}, "unit"), ({"decimal": "dot"}, "decimal"), ({"table_arm": "2"}, "table_arm"),
        ({"instrument": "1"}, "instrument"), ({"column": "x=\n"}, "column"), ({"rate_hz": "nan"}, "rate_hz"),
        ({"column": ["x=a"] * 31}, "column"),
    ],
)  # fmt: skip
@pytest.mark.parametrize("path", ["/recordings", "/recordings/preview"])
def test_an_impossible_parameter_is_refused_by_its_name(here: Service, path, query, where):
    answer = send(here, path, POSITIONS, **query)
    assert answer.status_code in (400, 422)
    assert where in answer.text
    assert recordings(here) == 0


def test_what_was_said_is_stored_and_used_when_the_table_is_cut_again(here: Service):
    stored = here.client.add_recording(POSITIONS, **SAID | {"frame": "PSM2_base", "table_arm": "PSM2"})
    demo = here.client.cut_demo(stored["id"], **KESTREL)
    assert (demo["arm"], demo["frame"], demo["report"]["path_states"]) == ("PSM2", "PSM2_base", 28)
    again = here.client.add_demo(POSITIONS, **KESTREL, **SAID | {"frame": "PSM2_base", "table_arm": "PSM2"})
    assert again["id"] == demo["id"]
    assert_problem(send(here, "/recordings", POSITIONS, **SAID), 409)
    with here.database.reading() as session:
        reading = session.scalars(select(StoredRecording.reading)).one()
    assert reading.options == {"rate_hz": 100.0, "frame": "PSM2_base", "table_arm": "PSM2",
                       "column": SAID["column"], "unit": ["mm"]}  # fmt: skip


def test_a_table_that_needs_no_answers_is_stored_as_before(here: Service):
    here.client.add_recording(b"t_s,x_mm,y_mm,z_mm\n0,0,50,-120\n1,10,50,-120\n")
    with here.database.reading() as session:
        row = session.scalars(select(StoredRecording)).one()
    assert row.reading == TableIn()
    assert not {"columns", "timed"} & row.about.model_fields_set


def test_both_arms_of_an_ee_csv_are_stored_and_one_is_cut(here: Service):
    data = written.ee_csv(more=True).encode()
    assert "in which frame" in assert_problem(send(here, "/recordings", data), 422)["detail"]
    stored = here.client.add_recording(data, frame="ECM")
    assert {(one["arm"], one["joints"]) for one in stored["joints"]} == {("PSM1", 6), ("PSM2", 6)}
    demo = here.client.cut_demo(stored["id"], **KESTREL, arm="PSM2")
    assert (demo["topic"], demo["frame"]) == ("/PSM2/local/measured_cp", "PSM2_base")


def test_counts_of_samples_are_in_the_answer_the_report_and_on_the_page(here: Service):
    rows = [f"{k * 0.01:.2f},{min(k, 150) * 0.2:.2f},50,-120" for k in range(200)]
    rows[50] = rows[50].replace("0.50,", "0.48,")
    data = "\n".join(["t_s,x_mm,y_mm,z_mm", *rows]).encode()
    stored = here.client.add_recording(data)
    assert stored["dropped"] == [{"topic": "table", "backward_stamps": 1}]
    assert stored["quality"][0]["equal_samples"] == 49
    demo = here.client.cut_demo(stored["id"], **KESTREL, segment="whole")
    for report in (demo["report"], here.client.demo_report(demo["id"])["report"]):
        assert (report["backward_stamps"], report["equal_samples"]) == (1, 49)
        assert any("1 sample had a stamp that went back" in line for line in report["advice"])
        assert any("49 of 199 samples (25%) repeat the pose" in line for line in report["advice"])
    page = here.http.get(f"/pages/recordings/{stored['id']}", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert "Stamps that went back" in page.text
    assert "Equal samples" in page.text
    text = here.client.demo_report_page(demo["id"]).decode()
    assert "Stamps that went back" in text
    assert "49, 24.6 %" in text


@pytest.mark.needs("recordings")
def test_a_real_bag_with_a_stamp_that_goes_back_is_stored_with_counts(here: Service):
    stored = here.client.add_recording(Path(sample_folder() / "calibration" / "pitch_exp_traj_02_test_cropped.bag"))
    assert {one["topic"]: one["backward_stamps"] for one in stored["dropped"]} == {
        "/PSM2/measured_cp": 1,
        "/PSM2/measured_js": 1,
    }
    assert stored["motions"][0]["samples"] == 3299


@pytest.mark.parametrize("of", [4, pytest.param(25, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("name", ["ee_csv with joints", "mapped with decimal commas"])
def test_a_damaged_table_is_no_error_of_the_service(here: Service, name: str, of: int):
    text, said = FILES[name]
    data = text.encode()
    damaged = [*mutations(text, of, seed=7), *hostile.truncations(data, of, seed=7), *hostile.flips(data, of, seed=7)]
    for one in damaged:
        answer = send(here, "/recordings/preview", one, **said)
        assert answer.status_code in (200, 415, 422), answer.text
    assert recordings(here) == 0
    assert send(here, "/recordings/preview", data, **said).status_code == 200
