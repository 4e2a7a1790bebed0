"""Datasets over HTTP: requested, downloaded whole or not at all, unpacked by client and command."""

import asyncio
import hashlib
import io
from pathlib import Path
from typing import Any

import pytest

from skills.api import streams
from skills.client import Problem
from skills.errors import BadInput, Conflict
from skills.formats.bag_writer import write_mcap
from skills.formats.lerobot.manifest import check_dataset
from skills.library.recordings import datasets
from tests.api.keyed import As, key
from tests.api.service import KESTREL, MCAP, Service, assert_problem
from tests.library import exports
from tests.library.exports import session_of
from tests.library.test_datasets import NO_EXPORT

ZIP = "application/zip"


@pytest.fixture(autouse=True)
def here(monkeypatch: pytest.MonkeyPatch) -> None:
    exports.in_this_process(monkeypatch)


def add(service: Service, shift: float = 0.0) -> str:
    service.client.put_surgeon("kestrel")
    data = write_mcap(session_of((shift, 0.0, 0.0)))
    return service.client.add_demo(data, media_type=MCAP, arm="PSM1", segment="whole", **KESTREL)["id"]


def exported(service: Service, **asked: Any) -> str:
    job = service.client.export_dataset(**asked)
    service.work()
    return service.client.job(job["id"])["result"]["dataset"]


def test_a_dataset_is_requested_and_downloaded(service: Service):
    add(service)
    asked = service.http.post("/datasets", json={"fps": 50})
    assert (asked.status_code, asked.json()["did"]) == (202, "A new job is queued.")
    assert service.http.post("/datasets", json={"fps": 50}).json()["id"] == asked.json()["id"]
    service.work()
    job = service.http.post("/datasets", json={"fps": 50})
    assert job.status_code == 200
    result = job.json()["result"]
    found = service.http.get(f"/datasets/{result['dataset']}")
    assert hashlib.sha256(found.content).hexdigest() == result["dataset"]
    assert (len(found.content), result["episodes"], result["frames"]) == (result["size_bytes"], 1, 60)
    tag = f'"{result["dataset"]}"'
    assert (found.headers["etag"], found.headers["content-type"]) == (tag, ZIP)
    assert check_dataset(io.BytesIO(found.content))
    short = service.http.get(f"/datasets/{result['dataset'][:12]}", headers={"If-None-Match": tag})
    assert (short.status_code, short.content) == (304, b"")
    assert [one["id"] for one in service.client.jobs(kind="dataset")] == [asked.json()["id"]]


@pytest.mark.parametrize("whole", [False, True])
def test_the_episodes_of_a_dataset_are_named_in_their_order(service: Service, whole: bool):
    demos = [add(service, shift) for shift in (0.0, 1.0)]
    dataset = exported(service, whole=whole, fps=50)
    recordings = [service.client.demo(one)["recording"] for one in demos]
    found = service.client.dataset_episodes(dataset)
    named = [{"recording": one, "demos": [demo]} for one, demo in zip(recordings, demos, strict=True)]
    assert found == {"whole": whole, "episodes": named}
    service.client.delete_dataset(dataset)
    assert_problem(service.http.get(f"/datasets/{dataset}/episodes"), 404, "not-found")


def test_a_deleted_dataset_is_gone_with_its_job(service: Service):
    add(service)
    dataset = exported(service)
    service.client.delete_dataset(dataset)
    assert_problem(service.http.get(f"/datasets/{dataset}"), 404, "not-found")
    assert service.client.jobs(kind="dataset") == []
    assert exported(service)


@pytest.mark.parametrize(
    "body",
    [
        {"demos": []}, {"demos": ["x"]}, {"demos": ["0" * 64], "surgeons": ["kestrel"]}, {"demos": ["0" * 8] * 1001},
        {"surgeons": []}, {"surgeons": ["Anna B."]}, {"sutures": [1]}, {"outcomes": "failure"}, {"whole": 1},
        {"version": "v4.0"}, {"fps": 0}, {"fps": 1001}, {"fps": 29.97}, {"fps": True}, {"split": "random"},
        {"arms": []}, {"arms": ["PSM1", "psm1"]}, {"arms": ["../PSM1"]}, {"name": ""}, {"name": "a\nb"},
        {"name": "x" * 201}, {"licence": "\x00"}, {"description": "x" * 2001}, {"procedure": "\x1b[31m"}, {"more": 1},
    ],
    ids=str,
)  # fmt: skip
def test_a_hostile_request_is_refused(service: Service, body: dict[str, Any]):
    assert_problem(service.http.post("/datasets", json=body), 422, "invalid-request")
    assert service.counts()["jobs"] == 0


def test_what_is_unknown_or_not_consented_to_is_refused(service: Service):
    assert_problem(service.http.post("/datasets", json={}), 409, "conflict")
    add(service)
    assert_problem(service.http.post("/datasets", json={"surgeons": ["nobody"]}), 404, "not-found")
    assert_problem(service.http.post("/datasets", json={"arms": ["PSM3"]}), 422, "bad-input")
    dataset = exported(service)
    service.client.put_surgeon("kestrel", consent=NO_EXPORT)
    for answer in (service.http.post("/datasets", json={}), service.http.get(f"/datasets/{dataset}")):
        assert "consent of 'kestrel' does not cover export" in assert_problem(answer, 409, "conflict")["detail"]
    tag = {"If-None-Match": f'"{dataset}"'}
    assert_problem(service.http.get(f"/datasets/{dataset}", headers=tag), 409, "conflict")


def test_consent_withdrawn_during_a_download_cuts_it_off(service: Service, monkeypatch: pytest.MonkeyPatch):
    """All is verified, and some was sent: then the consent ends, and the rest is not sent."""
    monkeypatch.setattr(datasets, "CHUNK_BYTES", 4096)
    add(service)
    dataset = exported(service)
    chunks, read, sent = service.counts()["dataset_chunks"], 0, []

    def chunk(number: int) -> bytes | None:
        nonlocal read
        read += 1
        if read == chunks + 4:  # the first pass has read one more than there are
            service.client.put_surgeon("kestrel", consent=NO_EXPORT)
        return datasets.dataset_chunk(service.database, dataset, number)

    async def download() -> None:
        async for piece in streams.stored_pieces(chunk, lambda: None, dataset, service.app.state.downloads):
            sent.append(piece)  # noqa: PERF401 - those that were sent before the error count

    with pytest.raises(Conflict, match="does not cover export"):
        asyncio.run(download())
    assert 0 < len(sent) < chunks


def test_a_damaged_dataset_is_not_sent(service: Service):
    add(service)
    dataset = exported(service)
    service.tamper("UPDATE dataset_chunks SET data = zeroblob(10)")
    assert_problem(service.http.get(f"/datasets/{dataset}"), 503, "corrupt")


def test_roles_and_restricted_keys_are_kept(service: Service):
    """A reader downloads, a trainer exports; a key of wren's knows nothing of kestrel's datasets."""
    add(service)
    dataset = exported(service)
    service.client.put_surgeon("wren")
    job = service.client.jobs(kind="dataset")[0]["id"]
    reader, trainer = (As(service, key(service, role, role)) for role in ("reader", "trainer"))
    of_wren = As(service, key(service, "ada", "trainer", surgeons=["wren"]))
    assert_problem(reader("POST", "/datasets", json={}), 403)
    assert_problem(reader("DELETE", f"/datasets/{dataset}"), 403)
    assert reader("GET", f"/datasets/{dataset}").status_code == 200
    assert trainer("POST", "/datasets", json={}).json()["result"]["dataset"] == dataset
    assert_problem(of_wren("POST", "/datasets", json={}), 409)
    here = f"/datasets/{dataset}"
    for method, path in (("GET", here), ("GET", f"{here}/episodes"), ("DELETE", here), ("GET", f"/jobs/{job}")):
        assert_problem(of_wren(method, path), 404)
    assert of_wren("GET", "/jobs").json()["items"] == []


# ---- the client -----------------------------------------------------------------------------------------------------


def test_the_client_saves_a_zip_or_a_verified_folder(service: Service, tmp_path: Path):
    add(service)
    dataset = exported(service, name="Sutures", arms=["PSM1"])
    service.client.save_dataset(dataset, tmp_path / "dataset.zip")
    service.client.save_dataset(dataset, tmp_path / "dataset")
    assert (tmp_path / "dataset" / "meta" / "README.md").read_text().startswith("# Sutures")
    assert hashlib.sha256((tmp_path / "dataset.zip").read_bytes()).hexdigest() == dataset
    for name in ("dataset.zip", "dataset"):
        with pytest.raises(BadInput, match="exists already"):
            service.client.save_dataset(dataset, tmp_path / name)
    assert sorted(one.name for one in tmp_path.glob(".*")) == []


def test_a_refused_download_leaves_nothing(service: Service, tmp_path: Path):
    add(service)
    dataset = exported(service)
    service.client.put_surgeon("kestrel", consent=NO_EXPORT)
    with pytest.raises(Problem, match="does not cover export"):
        service.client.save_dataset(dataset, tmp_path / "dataset")
    assert not [one.name for one in tmp_path.iterdir() if "dataset" in one.name]
