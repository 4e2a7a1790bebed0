"""Clients generated from the OpenAPI document by two well-known generators, against the real service on loopback.

Both upload, train with a release, read the policy, and download it with its arrays, the recording and a picture.
"""

import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.api.conformance import conformance
from tests.e2e.conftest import Service, running
from tests.library import cases

GENERATOR = "openapi-python-client==0.29.1"
HERE = Path(__file__).parent

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with running(tmp_path_factory.mktemp("generated")) as service:
        yield service


@pytest.fixture
def document(tmp_path: Path) -> Path:
    path = tmp_path / "openapi.json"
    path.write_text(json.dumps(conformance().document))
    return path


@pytest.fixture
def table(tmp_path: Path) -> Path:
    path = tmp_path / "hand_off.csv"
    path.write_bytes(cases.hand_off())
    return path


def run(*command: str | Path, cwd: Path) -> str:
    """Run a command that must succeed, and return its output."""
    ran = subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=900)
    assert ran.returncode == 0, f"{command[0]}: {ran.stdout[-3000:]}{ran.stderr[-3000:]}"
    return ran.stdout + ran.stderr


def installed(*command: str | Path, cwd: Path) -> None:
    """Install a dependency of a test, or skip the test with a message."""
    ran = subprocess.run([*map(str, command)], cwd=cwd, capture_output=True, text=True, timeout=900)
    if ran.returncode != 0:
        pytest.skip(f"the generator of a client is not here: {Path(command[0]).name} could not install it")


def test_the_client_of_openapi_python_client(service: Service, document: Path, table: Path, tmp_path: Path):
    run(sys.executable, "-m", "venv", "venv", cwd=tmp_path)
    python = tmp_path / "venv" / "bin" / "python"
    installed(python, "-m", "pip", "install", "-q", GENERATOR, cwd=tmp_path)
    generate = (python, "-m", "openapi_python_client", "generate", "--path", document, "--meta", "none")
    said = run(*generate, "--output-path", tmp_path / "made", cwd=tmp_path)
    assert "will not be generated" not in said
    assert "omitted" not in said
    assert "removal" not in said
    made = {path.stem for path in (tmp_path / "made" / "api").glob("*/*.py")} - {"__init__"}
    calls = [call for calls in conformance().document["paths"].values() for call in calls.values()]
    assert made == {call["operationId"] for call in calls}
    shutil.copy(HERE / "python_client.py", tmp_path)
    assert "version " in run(python, "python_client.py", service.url, table, cases.SUTURE, cwd=tmp_path)


@pytest.mark.needs("npm")
def test_the_client_of_openapi_typescript(service: Service, document: Path, table: Path, tmp_path: Path):
    folder = tmp_path / "typescript"
    shutil.copytree(HERE / "typescript", folder)
    installed("npm", "ci", "--no-audit", "--no-fund", cwd=folder)
    binaries = folder / "node_modules" / ".bin"
    run(binaries / "openapi-typescript", document, "-o", "api.d.ts", cwd=folder)
    run(binaries / "tsc", cwd=folder)
    assert "version " in run("node", "built/client.js", service.url, table, cases.SUTURE, cwd=folder)
