"""Recordings with jaws, and the export of demonstrations of them as datasets."""

import io
import zipfile
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from skills.db.service_tables import DatasetChunk, Job, StoredDataset
from skills.db.session import Database
from skills.demonstration.recording import Motion, Recording, Signal
from skills.formats import read_recording, write_mcap
from skills.formats.lerobot.cut import cut_episode, episodes_of, find_dataset
from skills.formats.parsed import parse_recording
from skills.library.recordings.datasets import dataset_chunk, request_dataset
from skills.schemas.datasets import DatasetIn
from tests.library import cases

ARMS = ("PSM1", "PSM2")
PASS_S = 60 / cases.RATE_HZ  # of each hand-off in a session


def session_of(*passes: tuple[float, float, float], arms: tuple[str, ...] = ARMS) -> Recording:
    """Return a recording of hand-offs one after another, each with its shift in mm; the jaw is the number of a sample.

    A pass has 60 samples at 50 Hz.
    """
    tip = np.concatenate([cases.points_mm(shift) for shift in passes or ((0.0, 0.0, 0.0),)])
    stamps_ns = cases.START_NS + np.arange(len(tip)) * (10**9 // cases.RATE_HZ)
    down = np.tile([np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0], (len(tip), 1))
    motions = [
        Motion(arm, f"/{arm}/local/measured_cp", f"{arm}_base", stamps_ns, tip + 2.0 * k, down)
        for k, arm in enumerate(arms)
    ]
    jaws = [(arm, Signal(stamps_ns, np.arange(len(tip)) / 1024.0)) for arm in arms]
    return Recording("mcap", "full", tuple(motions), tuple(jaws))


def add(database: Database, recording: Recording, surgeon: str = "kestrel", **cut: Any) -> str:
    """Store a demonstration by PSM1, by default of the whole recording, and return its digest."""
    if not {"start_s", "end_s"} & {*cut}:
        cut["segment"] = "whole"
    sent = cases.upload(write_mcap(recording), "application/vnd.mcap")
    return cases.store(database, sent, surgeon, **{"arm": "PSM1"} | cut).sha256


def ask(database: Database, **asked: Any) -> Job:
    with database.writing() as session:
        return request_dataset(session, DatasetIn(**{"fps": cases.RATE_HZ} | asked), "test")[0]


def export(database: Database, **asked: Any) -> str:
    """Export a dataset as a worker does, and return its digest."""
    return dataset_of(database, cases.work(database, ask(database, **asked)))


def dataset_of(database: Database, job: Job) -> str:
    """Return the digest of the dataset that a job has made."""
    with database.reading() as session:
        done = session.get_one(Job, job.row)
    assert done.state == "succeeded", done.error
    return str(done.result["dataset"])


def zip_of(database: Database, dataset: str) -> bytes:
    """Download a dataset."""
    chunks, number = [], 0
    while (chunk := dataset_chunk(database, dataset, number)) is not None:
        chunks.append(chunk)
        number += 1
    return b"".join(chunks)


def members(data: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        assert archive.testzip() is None
        return {name: archive.read(name) for name in archive.namelist()}


def read_episode(data: bytes, folder: Path, number: int) -> Recording:
    """Read an episode of a zip with our own reader."""
    file = folder / "dataset.zip"
    file.write_bytes(data)
    with find_dataset(file) as dataset, io.BytesIO() as out:
        cut_episode(dataset, episodes_of(dataset)[number], out)
        return read_recording(out)


def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Read recordings without starting a reader's process."""
    reader = SimpleNamespace(parse=parse_recording, server=SimpleNamespace(close=lambda: None))
    monkeypatch.setattr("skills.library.recordings.datasets.confined_reader", lambda _settings: reader)


def kept(database: Database) -> tuple[int, int, int]:
    """Count the datasets, their chunks, and the jobs that make them."""
    with database.reading() as session:
        datasets, chunks = session.query(StoredDataset).count(), session.query(DatasetChunk).count()
        return datasets, chunks, session.query(Job).filter_by(kind="dataset").count()
