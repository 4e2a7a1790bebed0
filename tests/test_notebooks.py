"""The notebooks run from beginning to end, and are stored without results.

Their cells run in their order as Python, without Jupyter; the last expression of a cell is shown as in Jupyter, by
its `_repr_html_` or its `repr`. Lines with `%` or `!` are not Python, and fail.
"""

import ast
import json
from pathlib import Path
from typing import Any

import matplotlib
import pytest

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
NIGHTLY = ("batches", "comparing_surgeons", "first_bag", "paper_redrawn")  # by day the lightest one
NAMES = [
    pytest.param(file.stem, marks=[pytest.mark.nightly] * (file.stem in NIGHTLY))
    for file in sorted(NOTEBOOKS.glob("*.ipynb"))
]


def cells_of(name: str) -> list[dict[str, Any]]:
    notebook = json.loads((NOTEBOOKS / f"{name}.ipynb").read_text())
    assert (notebook["nbformat"], notebook["nbformat_minor"]) == (4, 5)
    return notebook["cells"]


def shown(source: str, name: str, values: dict[str, Any]) -> str:
    """Run a cell, and return its last expression as a notebook shows it."""
    parsed = ast.parse(source, name)
    last = parsed.body.pop() if parsed.body and isinstance(parsed.body[-1], ast.Expr) else None
    exec(compile(parsed, name, "exec"), values)
    if last is None:
        return ""
    value = eval(compile(ast.Expression(last.value), name, "eval"), values)
    html = value._repr_html_() if hasattr(value, "_repr_html_") else None  # a figure has one for other front ends only
    return html or ("" if value is None else repr(value))


def test_there_are_five_and_each_begins_with_its_title():
    assert len(NAMES) == 5
    for name in (one.values[0] for one in NAMES):
        first = cells_of(name)[0]
        assert first["cell_type"] == "markdown"
        assert first["source"][0].startswith("# ")


@pytest.mark.parametrize("name", [one.values[0] for one in NAMES])
def test_a_notebook_is_stored_without_results_and_with_unique_cells(name):
    cells = cells_of(name)
    assert len({cell["id"] for cell in cells}) == len(cells)
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert len(code) >= 4
    assert [cell for cell in code if cell["outputs"] or cell["execution_count"] is not None] == []


@pytest.mark.parametrize("name", NAMES)
def test_a_notebook_runs_from_beginning_to_end(name, capsys):
    matplotlib.use("agg")
    values: dict[str, Any] = {"__name__": "__main__"}
    code = [cell for cell in cells_of(name) if cell["cell_type"] == "code"]
    results = [shown("".join(cell["source"]), f"{name}, cell {cell['id']}", values) for cell in code]
    assert any(results)
    assert capsys.readouterr().out
