"""Keys of a real service: created and revoked in another process, and over TLS."""

import ssl
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import httpx2 as httpx
import pytest

from skills.api.authentication import REMEMBERED_S
from skills.client import Client
from skills.db.session import Database
from skills.library.people.keys import create_key, revoke_key
from tests import backends
from tests.api.service import serving
from tests.e2e.conftest import Service, running
from tests.waiting import END_S


@pytest.fixture(params=["here", *(pytest.param(one, marks=pytest.mark.nightly) for one in backends.BACKENDS)])
def installation(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[httpx.Client, Database]]:
    """Yield a client of a service, and another connection to its database; by day the service is in this process."""
    if request.param == "here":
        url = backends.fresh("sqlite", tmp_path)
        with serving(url) as service, closing(Database(url)) as database:
            yield service.http, database
        return
    url = backends.fresh(request.param, tmp_path)
    apart = running(tmp_path, database_url=url, workers=0)
    with (
        apart as service,
        httpx.Client(base_url=service.url, timeout=END_S) as http,
        closing(Database(url)) as database,
    ):
        yield http, database
    backends.drop(url)


def asked(http: httpx.Client, wanted: int, **headers: str) -> list[tuple[float, int]]:
    """Repeat a request until it gets a status; return when each request began, and its status."""
    found: list[tuple[float, int]] = []
    while not found or found[-1][1] != wanted:
        assert not found or time.monotonic() - found[0][0] < END_S, found[-1]
        began = time.monotonic()
        found.append((began, http.get("/surgeons", headers=headers).status_code))
    return found


def test_a_key_made_or_revoked_in_one_process_counts_in_another_within_1_s(installation: tuple[httpx.Client, Database]):
    http, database = installation
    assert http.get("/surgeons").status_code == 200
    with database.writing() as session:
        key, text = create_key(session, "anna", "reader", "local")
    made = time.monotonic()
    let_in = [began for began, status in asked(http, 401) if status == 200]
    assert all(began < made + REMEMBERED_S for began in let_in)
    assert asked(http, 200, **{"X-API-Key": text})[0][1] == 200  # a key is valid from its creation on
    with database.writing() as session:
        revoke_key(session, key.id, "local")
    revoked = time.monotonic()
    let_in = [began for began, status in asked(http, 401, **{"X-API-Key": text}) if status == 200]
    assert all(began < revoked + REMEMBERED_S for began in let_in)
    print(f"let in for {max([revoked, *let_in]) - revoked:.2f} s after it was revoked")


def wait_until_alive(http: httpx.Client, process: subprocess.Popen[bytes]) -> None:
    """Wait until the service answers a request without a key; readiness is visible to readers only."""
    deadline = time.monotonic() + END_S
    while True:
        try:
            assert http.get("/healthz").status_code == 200
            return
        except httpx.TransportError:
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)


@pytest.mark.nightly  # uvicorn's own; the settings are tested by day
@pytest.mark.needs("openssl")
def test_it_speaks_tls_itself_and_its_cookie_then_goes_over_tls_alone(tmp_path: Path):
    cert, secret = tmp_path / "cert.pem", tmp_path / "key.pem"
    made = [
        "openssl",
        "req",
        "-x509",
        "-newkey",
        "ec",
        "-pkeyopt",
        "ec_paramgen_curve:prime256v1",
        "-nodes",
        "-days",
        "1",
    ]
    names = ["-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    subprocess.run([*made, *names, "-keyout", str(secret), "-out", str(cert)], check=True, capture_output=True)
    service = Service(tmp_path, tls_cert=cert, tls_key=secret, workers=0)
    with closing(Database(f"sqlite:///{service.database}")) as database:
        database.migrate()
        with database.writing() as session:
            text = create_key(session, "anna", "admin", "local")[1]
    service.launch()
    assert service.process is not None
    address = f"https://localhost:{service.port}"
    try:
        with httpx.Client(base_url=address, verify=ssl.create_default_context(cafile=str(cert)), timeout=END_S) as http:
            wait_until_alive(http, service.process)
            assert Client(http, api_key=text).put_surgeon("heron").surgeon == "heron"
            signed_in = http.post("/sign-in", data={"key": text})
            assert signed_in.status_code == 303
            assert "Secure" in signed_in.headers["set-cookie"].split("; ")
            assert http.get("/surgeons").json()["items"][0]["surgeon"] == "heron"
        with pytest.raises(httpx.TransportError):
            httpx.get(f"http://localhost:{service.port}/healthz", timeout=END_S)
    finally:
        service.stop()
