"""Generator of a release's fixture: `make fixture`, by hand at each release; its output is kept for ever.

    releases/VERSION/skills.sqlite        a populated installation in one file
    releases/VERSION/postgresql.sql.gz    the same, as PostgreSQL's own `pg_dump --inserts` writes it
    releases/VERSION/expected.json        ETag and SHA-256 of each policy that it serves, as JSON and as arrays; of
                                          arrays also the digest of their numbers, because their compression
                                          depends on the zlib that Python was built with
    releases/VERSION/signing.key          the key of its history; it signs nothing else

The installation is made once, through the service's own calls, on SQLite; PostgreSQL gets it by restoring a backup.
The dump holds the tables as that version made them, so it does not require our migrations to stay unchanged; written
as INSERTs it can be run through psycopg, without `psql`. `pg_dump` comes with the server of the tests.
"""

import gzip
import hashlib
import io
import json
import os
import sqlite3
import subprocess
import tempfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from sqlalchemy import make_url, select

from skills import __version__
from skills.db.models import StoredPictures, StoredPlayback
from skills.db.session import Database, revisions
from skills.library.backup import back_up, restore
from skills.library.calibrations import Rated, calibrate_on, keep
from skills.library.history import sign_history
from skills.packing import canonical, sha256
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from skills.verification.playback import Pictures
from tests import backends
from tests.api.service import CSV, GOAL_MM, KESTREL, MCAP, Service, serving
from tests.library import cases
from tests.scoring.cohorts import cohort

RELEASES = Path(__file__).parent / "releases"
SURGEONS = ("kestrel", "heron")
JSON, NPZ = "application/json", "application/x-npz"


def main() -> None:
    """Write the fixture of this version anew."""
    target = RELEASES / __version__
    target.mkdir(parents=True, exist_ok=True)
    os.environ["SKILLS_SIGNING_KEY"] = str(target / "signing.key")
    settings.cache_clear()
    with tempfile.TemporaryDirectory(prefix="skills-fixture-") as name:
        folder = Path(name)
        url = backends.fresh("sqlite", folder)
        with serving(url) as service:
            populate(service)
            sign_history(service.database, None)
            expected = {"schema": revisions()[0], "zlib": zlib.ZLIB_RUNTIME_VERSION, "policies": policies_of(service)}
            back_up(service.database, folder / "backup.zip")
        write_sqlite(Path(make_url(url).database or ""), target / "skills.sqlite")
        write_postgresql(folder / "backup.zip", target / "postgresql.sql.gz")
    (target / "expected.json").write_text(json.dumps(expected, indent=1) + "\n")
    for file in sorted(target.iterdir()):
        print(f"{file.relative_to(RELEASES)}: {file.stat().st_size / 1e3:.0f} kB")


def populate(service: Service) -> None:
    """Make at least one row of every table, through the service's own calls."""
    client = service.client
    every_use = {"uses": ["training", "export", "atlas"], "until": None}
    client.put_surgeon("kestrel", skill_level="expert", consent=every_use)
    tables = [cases.hand_off((0.0, y_mm, 0.0)) for y_mm in (0.5, 0.0)]
    both = [client.add_demo(one, media_type=CSV, **KESTREL)["id"] for one in tables]
    client.put_surgeon("heron", handedness="left", consent=every_use)
    bag = next(sample.data for sample in sample_recordings() if sample.surgeon == "heron")
    client.add_demo(bag, media_type=MCAP, surgeon="heron", suture=cases.SUTURE)
    withdrawn = client.add_demo(cases.hand_off((0.0, 2.5, 0.0)), media_type=CSV, surgeon="heron", suture=cases.SUTURE)
    client.withdraw_demo(withdrawn["id"])
    turned = client.add_demo(cases.bag(), media_type=MCAP, **KESTREL)["id"]
    client.mark_demo(turned, "recovery", reason="the needle was grasped twice")
    between_rests = np.pad(cases.points_mm(), ((100, 100), (0, 0)), "edge")
    recording = client.add_recording(cases.bag(tip=between_rests), media_type=MCAP, surgeon="kestrel")["id"]
    client.decide_proposal(recording, 1, "rejected", note="another needle")
    client.put_surgeon("wren")
    client.erase_surgeon("wren")
    client.retrain(release=True)
    client.cancel(client.train(surgeon="heron", suture=cases.SUTURE, seed=3)["id"])
    client.train(**KESTREL, demos=both, combine="corridor")
    client.train(**KESTREL, learner={"kind": "value-iteration"}, release=True)
    client.export_dataset(surgeons=["heron"])
    service.work()
    client.nearest(both[0])
    plan = client.plan(**KESTREL, suture_points=[GOAL_MM], handoff="none")
    client.play(plan["id"])
    service.work()
    with service.database.writing() as session:  # real pictures are as large as all the rest; their job stays queued
        playback = session.scalars(select(StoredPlayback.row)).one()
        session.add(StoredPictures(playback_row=playback, drawn=Pictures(b"mp4", b"gif", b"png", b"png")))
        keep(session, calibrate_on(Rated(cohort(), {}, {}), permutations=39), "test")


def policies_of(service: Service) -> dict[str, Any]:
    """Return every served policy and every version, byte for byte as a client gets it."""
    client = service.client
    served = [f"/policies/{one['surgeon']}/{one['suture']}" for one in client.policies()]
    versions = [
        f"/policy-versions/{version['sha256']}"
        for surgeon in SURGEONS
        for version in client.versions(surgeon, cases.SUTURE)
    ]
    return {path: {kind: answer_of(service, path, kind) for kind in (JSON, NPZ)} for path in served + versions}


def answer_of(service: Service, path: str, media_type: str) -> dict[str, str]:
    """Return the ETag and the digest of the bytes of one response."""
    answer = service.http.get(path, headers={"Accept": media_type})
    assert answer.status_code == 200, answer.text
    said = {"etag": answer.headers["etag"], "sha256": hashlib.sha256(answer.content).hexdigest()}
    return said | {"numbers": numbers_of(answer.content)} if media_type == NPZ else said


def numbers_of(npz: bytes) -> str:
    """Return the digest of arrays, independent of their compression."""
    with np.load(io.BytesIO(npz)) as arrays:
        parts = [[name, str(a.dtype), list(a.shape), sha256(a.tobytes())] for name, a in sorted(arrays.items())]
    return sha256(canonical(parts))


def write_sqlite(source: Path, target: Path) -> None:
    """Write a database as one file, without its free pages and log."""
    target.unlink(missing_ok=True)
    connection = sqlite3.connect(source)
    connection.execute("VACUUM INTO ?", (str(target),))
    connection.close()


def write_postgresql(backup: Path, target: Path) -> None:
    """Restore a backup into PostgreSQL, and dump that."""
    url = backends.blank("postgresql", backup.parent)
    database = Database(url)
    restore(database, backup)
    database.close()
    server = (backends.server().pgdata / "postmaster.opts").read_text().split()[0]  # the wheel has several versions
    where = make_url(url).set(drivername="postgresql").render_as_string(hide_password=False)
    options = ["--inserts", "--rows-per-insert=50", "--no-owner", "--no-privileges", "--no-comments"]
    dump = subprocess.run([Path(server).with_name("pg_dump"), *options, where], check=True, capture_output=True).stdout
    lines = [line for line in dump.splitlines(keepends=True) if not line.startswith(b"\\")]  # psql's own commands
    target.write_bytes(gzip.compress(b"".join(lines), mtime=0))
    backends.drop(url)


if __name__ == "__main__":
    main()
