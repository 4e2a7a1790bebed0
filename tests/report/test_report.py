"""`skills report`: the command, its page, and its numbers, which must equal the core's."""

import json
import os
import re
from html import unescape
from html.parser import HTMLParser
from pathlib import Path

import pytest
from typer.testing import CliRunner

from skills.cli import app
from skills.gridworld.reward import sparse_reward
from skills.learning.evaluation import measure
from skills.learning.policy import learn_tabular, rollout_from
from skills.learning.q_learning import CellQLearning
from skills.report.numbers import sample_source
from skills.report.rivals import SLIPS
from skills.settings import settings

QUICK = ("--irl-iterations", "3", "--seeds", "2", "--runs", "20")
FIGURES = ("fig-5", "fig-6", "fig-7", "fig-8", "fig-9")
PICTURES = (*FIGURES, "rivals")
PNG = b"\x89PNG\r\n\x1a\n"


class Page(HTMLParser):
    """The content of a page: its tables by id, images, sections, and every address in it."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tables: dict[str, list[list[str]]] = {}
        self.tags: list[str] = []
        self.sections: list[str] = []
        self.alts: list[str] = []
        self.addresses: list[str] = []
        self._rows: list[list[str]] = []
        self._in_cell = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        self.tags.append(tag)
        self.addresses += [given[name] or "" for name in ("src", "href", "action", "srcset") if name in given]
        if tag == "section":
            self.sections.append(given["id"] or "")
        if tag == "img":
            self.alts.append(given["alt"] or "")
        if tag == "table":
            self._rows = self.tables[given["id"] or ""] = []
        if tag == "tr":
            self._rows.append([])
        if tag in ("td", "th"):
            self._rows[-1].append("")
            self._in_cell = True

    def handle_endtag(self, tag: str) -> None:
        self._in_cell = self._in_cell and tag not in ("td", "th")

    def handle_data(self, data: str) -> None:
        if self._in_cell:
            self._rows[-1][-1] += data


def run(to: Path, data: Path | None, *words: str) -> tuple[int, str, str]:
    """Run the command with the paper's data, or without; return exit code, standard output and standard error."""
    settings.cache_clear()
    try:
        answer = CliRunner(env={"SKILLS_PAPER_DATA": str(data) if data else None}).invoke(
            app, ["report", "--to", str(to), *QUICK, *words]
        )
    finally:
        settings.cache_clear()
    return answer.exit_code, answer.stdout, answer.stderr


@pytest.fixture(scope="module")
def without(tmp_path_factory: pytest.TempPathFactory):
    """Return the report of the sample alone: its folder, and the command's output."""
    to = tmp_path_factory.mktemp("without") / "made" / "by it"
    return to, *run(to, None)


@pytest.fixture(scope="module")
def page(without) -> Page:
    return Page((without[0] / "index.html").read_text())


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_without_the_papers_data_the_report_draws_the_sample_and_says_so(without):
    to, code, printed, said = without
    assert code == 0, printed + said
    assert "THE PAPER'S DATA IS MISSING" in said
    assert "THE PAPER'S DATA IS MISSING" in unescape((to / "index.html").read_text())
    assert sorted(file.name for file in to.glob("*.png")) == [f"{name}-sample.png" for name in PICTURES]
    assert all(file.read_bytes().startswith(PNG) for file in to.glob("*.png"))
    assert "DTW (mm)" in printed


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_the_page_has_every_figure_and_names_command_seed_and_tolerance(without, page):
    assert page.sections == [*FIGURES, "table-1", "rivals"]
    assert len(page.alts) == len(PICTURES) and all(page.alts)
    text = (without[0] / "index.html").read_text()
    made = re.findall(r"Command: skills report ([^.]*)\. Seed: [^.]+\. Tolerance: [^<]+\.</p>", text)
    assert made == [" ".join(QUICK)] * len(page.sections)


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_the_page_is_self_contained(without, page):
    assert not {"script", "link", "iframe", "object", "embed", "form", "base"} & set(page.tags)
    assert all(re.match(r"data:image/png;base64,|#", address) for address in page.addresses)
    text = re.sub(r'src="data:[^"]*"', "", (without[0] / "index.html").read_text())
    for way_out in ("http:", "https:", 'src="', "url(", "@import"):
        assert way_out not in text


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_the_numbers_of_the_page_are_those_of_the_core(page):
    path = sample_source().path
    head, *rows = page.tables["fig-8-sample"]
    assert head[5] == "DTW (mm)"
    for seed in range(3):
        policy = learn_tabular(sparse_reward(path), CellQLearning(), seed)
        followed = rollout_from(policy, path.start)
        assert rows[seed][1:4] == [f"seed {seed}", "yes", str(len(followed.states))]
        assert float(rows[seed][5]) == measure(followed).dtw_total_mm
    states = str(len(path.states))
    assert [row[3:6] for row in rows[3:]] == [[states, states, "0"]] * 5  # ours and the alternatives reproduce it
    assert page.tables["seeds-sample"][3][1:] == ["2", "1", "2", "2"]  # with the phase both seeds learn one table


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_the_pages_rmse_is_a_thousand_times_the_printed_one(page):
    assert [row[1:3] for row in page.tables["rmse"][1:]] == [
        ["0.0044", "4.432"],
        ["0.0027", "2.728"],
        ["0.002", "1.967"],
    ]


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_the_page_says_how_policy_and_rivals_fare_with_slips(page):
    head, *rows = page.tables["rivals-sample"]
    assert head[:3] == ["slip", "by", "follow (%)"]
    assert len(rows) == len(SLIPS) * len({row[1] for row in rows}) == 42
    follow = {(float(row[0]), row[1]): float(row[2]) for row in rows}
    assert [row[2] for row in rows[:7]] == [
        "100",
        "100",
        "100",
        "0",
        "100",
        "100",
        "100",
    ]  # the cell state cuts corners
    rivals = [share for (slip, by), share in follow.items() if slip == 0.1 and not by.startswith("ours")]
    assert follow[0.1, "ours: phase and cell"] >= 90 > 30 > max(rivals)
    exact = {(float(row[0]), row[1]): float(row[2]) for row in page.tables["rivals-exact-sample"][1:]}
    assert (exact[0.0, "ours: phase and cell"], round(exact[0.1, "ours: phase and cell"])) == (100, 99)
    assert all(exact[slip, "ours, solved for this slip"] > exact[slip, "ours: phase and cell"] for slip in SLIPS[1:])


@pytest.mark.nightly
def test_the_same_command_twice_gives_the_same_numbers_and_pictures(without, tmp_path):
    to, _, printed, _ = without
    again = run(tmp_path, None)
    assert again[:2] == (0, printed.replace(str(to), str(tmp_path)))
    for file in to.iterdir():
        assert (tmp_path / file.name).read_bytes() == file.read_bytes(), file.name


@pytest.mark.nightly  # of one report, which takes 8 s of processor time
def test_programs_get_the_tables_as_json(without):
    tables = {table["name"]: table for table in json.loads((without[0] / "numbers.json").read_text())}
    assert {"fig-5-sample", "seeds-sample", "table-1-sample", "ranges-sample", "rivals-sample", "rmse"} <= set(tables)
    assert all(len(row) == len(table["columns"]) for table in tables.values() for row in table["rows"])


@pytest.mark.nightly
@pytest.mark.needs("paper")
def test_with_the_papers_data_the_published_policies_stand_beside_ours(tmp_path):
    code, printed, said = run(tmp_path, Path(os.environ["SKILLS_PAPER_DATA"]), "--json")
    assert (code, "NOT HERE" in said) == (0, False), said
    assert len(list(tmp_path.glob("*.png"))) == 2 * len(PICTURES)
    tables = {table["name"]: table["rows"] for table in json.loads(printed)}
    assert [(row[0][:9], row[5], row[6]) for row in tables["fig-8-paper"][:3]] == [
        ("published", 140.0, 1205),
        ("published", 145.0, 1331),
        ("published", 145.0, 1181),
    ]
    assert [row[2:6] for row in tables["fig-8-paper"][6:]] == [["yes", 28, 28, 0.0]] * 5  # ours and the alternatives
    assert tables["fig-9-paper"][0][:2] == ["-25, 50, -135", "yes"]
    assert tables["fig-9-paper"][0][4:7] == ["no", "yes", "yes"]  # the single policy of Fig. 9 was not the first one
    assert tables["range-paper"] == [
        ["published policy 1", 30, 19],
        ["published policy 2", 30, 30],
        ["published policy 3", 30, 30],
        ["ours, seed 0", 30, 30],
        ["rival: shortest way, then replay", 30, 30],
        ["rival: dynamic movement primitive", 30, 30],
    ]
    by = {row[0]: row for row in tables["table-1-paper"]}
    assert by["published by the authors"][4] == 430.0
    assert by["the paper, as printed"][4] == pytest.approx(430, abs=3 * 0.0005 * 84)  # mm, by its rounding
    ranges = [row[3:] for row in tables["ranges-paper"] if row[0] == "published by the authors"]
    assert ranges == [[205, 330], [20, 155], [65, 85]]


def test_a_folder_that_is_not_the_papers_data_is_refused_by_what_it_lacks(tmp_path):
    code, _, said = run(tmp_path / "report", tmp_path)
    assert (code, "user_path_grid11.csv" in said) == (1, True)
    assert not (tmp_path / "report").exists()


def test_a_file_where_the_folder_should_be_is_refused(tmp_path):
    file = tmp_path / "report"
    file.write_text("mine")
    code, _, said = run(file, None)
    assert (code, "Name a folder" in said, file.read_text()) == (1, True, "mine")
