"""A full or failed disk and used up descriptors: 507 or 503 with the cause in the log; stored data are still served."""

import errno
import logging
import os
from pathlib import Path
from typing import IO

import pytest

from tests.api.conformance import conformance
from tests.api.keyed import As, key
from tests.api.service import CSV, KESTREL, POLICY, Service, assert_problem, copy_of_trained, serving
from tests.db.test_session import fill
from tests.library import cases


def test_a_full_disk_of_the_database_is_507(tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch):
    monkeypatch.setattr(logging.getLogger("skills.db.session"), "disabled", False)
    with serving(copy_of_trained(tmp_path)) as service:
        fill(service.database)
        other = cases.hand_off((0.0, 0.2, 0.0))
        answer = service.http.post("/demos", params=KESTREL, content=other, headers={"Content-Type": CSV})
        problem = assert_problem(answer, 507, "storage-full")
        assert "disk of the database is full" in problem["detail"]
        assert "retry-after" not in answer.headers
        assert "database or disk is full" in caplog.text
        assert service.http.get(POLICY).status_code == 200


def full_file(**_how: object) -> IO[bytes]:
    """Open a real file on a device without free space."""
    return Path("/dev/full").open("w+b", 0)


def test_a_full_disk_for_temporary_files_is_507(service: Service, caplog: pytest.LogCaptureFixture, monkeypatch):
    monkeypatch.setattr(logging.getLogger("skills.api"), "disabled", False)
    monkeypatch.setattr("skills.api.uploads.tempfile.SpooledTemporaryFile", full_file)
    answer = service.http.post("/demos", params=KESTREL, content=cases.hand_off(), headers={"Content-Type": CSV})
    assert_problem(answer, 507, "storage-full")
    assert "No space left on device" in caplog.text


@pytest.mark.parametrize(
    ("number", "status", "kind"),
    [
        (errno.EMFILE, 503, "busy"),
        (errno.ENFILE, 503, "busy"),
        (errno.EIO, 503, "busy"),
        (errno.EROFS, 503, "busy"),
        (errno.EDQUOT, 507, "storage-full"),
    ],
)
@pytest.mark.parametrize("place", ["skills.api.uploads.tempfile.SpooledTemporaryFile", "skills.sandbox.forked._ask"])
def test_what_the_system_refuses_for_now_is_no_internal_error(
    service: Service, place: str, number: int, status: int, kind: str, caplog: pytest.LogCaptureFixture, monkeypatch
):
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    service.client.put_surgeon("kestrel")
    monkeypatch.setattr(logging.getLogger("skills.api"), "disabled", False)
    monkeypatch.setattr(place, refuse)
    unread = cases.hand_off((0.01, 0.0, 0.0))  # what a process of tests has read, it does not read again
    answer = service.http.post("/demos", params=KESTREL, content=unread, headers={"Content-Type": CSV})
    assert_problem(answer, status, kind)
    assert ("retry-after" in answer.headers) == (status == 503)
    assert os.strerror(number) in caplog.text
    assert "unexpected" not in caplog.text


def test_how_somebody_else_read_the_same_bytes_is_not_told(tmp_path: Path):
    with serving(copy_of_trained(tmp_path)) as service:
        one, other = (As(service, key(service, owner, "uploader")) for owner in ("one", "other"))
        sent = {"content": cases.hand_off(), "headers": {"Content-Type": CSV}}
        own = {"content": cases.hand_off((0.3, 0.0, 0.0)), "headers": {"Content-Type": CSV}}
        assert one("POST", "/recordings", params={"frame": "PSM1_base"}, **own).status_code == 201
        told = assert_problem(one("POST", "/recordings", params={"frame": "PSM2_base"}, **own), 409)
        assert "PSM1_base" in told["detail"]
        refused = assert_problem(other("POST", "/recordings", params={"frame": "PSM2_base"}, **own), 409)
        assert "PSM1_base" not in str(refused) and "stored" in refused["detail"]
        assert other("POST", "/recordings", **sent).status_code == 201  # its file is parsed while it is stored


def test_507_is_in_the_document():
    paths = conformance().document["paths"]
    assert all("507" in call["responses"] for calls in paths.values() for call in calls.values())
