"""The examples of docs/client.md run, on the real service."""

import ast
import asyncio
import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import skills.client
from skills.seeds.recordings import sample_recordings
from skills.settings import settings
from tests.e2e.conftest import running

PAGE = (Path(__file__).parent.parent / "docs" / "client.md").read_text()
BLOCKS = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)


@pytest.fixture
def url(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    (tmp_path / "hand-off.mcap").write_bytes(sample_recordings()[0].data)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("SKILLS_API_KEY", raising=False)
    settings.cache_clear()
    with running(tmp_path) as service:
        yield service.url
    settings.cache_clear()


def run(block: str, names: dict[str, Any], loop: asyncio.Runner) -> None:
    """Run a block as a notebook runs a cell: top-level `await`, and the last value is shown."""
    code = compile(block, "client.md", "exec", flags=ast.PyCF_ALLOW_TOP_LEVEL_AWAIT)
    if code.co_flags & inspect.CO_COROUTINE:
        loop.run(eval(code, names))
    else:
        exec(code, names)


@pytest.mark.nightly  # 11 s of processor time; by day tests/e2e calls the real service with the client
def test_every_block_of_the_page_runs_in_the_order_of_the_page(url: str, capsys: pytest.CaptureFixture[str]) -> None:
    names: dict[str, Any] = {}
    with asyncio.Runner() as loop:
        for block in BLOCKS:
            run(block.replace("http://127.0.0.1:8000", url), names, loop)
        loop.run(names["notebook"].aclose())
    for one in ("client", "patient", "hasty"):
        names[one].close()
    printed = capsys.readouterr().out
    for said in (
        "22 states; 0.36",
        "DTW 0.0 mm; 1 pass of",
        "The path follows the reference all along: 0.0 mm from it on average. Not calibrated",
        "['succeeded', 'succeeded', 'succeeded']",
        "1 100 True",
        "100%\n",
        "succeeded 100%",
        "404 not-found",
        "http://127.0.0.1:9 gave no answer",
        "over plain HTTP, where others can read it",
        "[('kestrel', 'simple-running', 1)]",
        "['kestrel'] PSM2: Recognition needs at least two surgeons",
    ):
        assert said in printed, printed
    assert names["path"].finished
    assert Path("back.mcap").read_bytes() == Path("hand-off.mcap").read_bytes()
    assert len(repr(names["policy"])) < 4000


def test_the_page_names_all_that_can_be_raised() -> None:
    public = {name: getattr(skills.client, name) for name in skills.client.__all__}
    raised = [name for name, kind in public.items() if isinstance(kind, type) and issubclass(kind, Exception)]
    assert len(raised) >= 6
    assert [name for name in raised if f"| `{name}` |" not in PAGE] == []
