"""One motion has one sentence: page, list, player, JSON, command line and bag say the same of a plan.

Plans are feasible or not, with and without hand-off, tissue and obstacles.
"""

import io
import re
import zipfile
from html import unescape
from itertools import product
from typing import Any

import pytest

from skills.learning.ties import OPTIMAL
from skills.settings import settings
from tests.api.service import POLICY, Service
from tests.api.test_plans import APPROACH, BASE, GOAL_MM, plan
from tests.by_day import some
from tests.library import cases

FAR_MM, NEAR_MM = -175.0, -120.0
BOX = {"low_mm": [58.0, 58.0, -122.0], "high_mm": [62.0, 62.0, -118.0]}
HANDS = {
    "no hand-off": {},
    "approach alone": {"psm_m": {"approach": APPROACH}},
    "both arms": {"psm_m": {"approach": APPROACH, "base": BASE}},
}
TISSUES = {"none": None, "far": FAR_MM, "reached": NEAR_MM, "touched by the needle": -137.5, "just free": -160.0}
PLANS = [*product(HANDS, TISSUES, (False, True))]


def text_of(page: str) -> str:
    """Return the words of a page, without markup."""
    return re.sub(r"\s+", " ", unescape(re.sub(r"<[^>]+>", " ", page)))


def asked(hands: str, tissue: str, boxes: bool) -> dict[str, Any]:
    height_mm = TISSUES[tissue]
    if height_mm is None and not boxes:
        return HANDS[hands]
    plane = {"at_mm": [0.0, 0.0, height_mm], "normal": [0.0, 0.0, 1.0], "along": [1.0, 0.0, 0.0]}
    scene = {"frame": "PSM_base", "boxes": [BOX] * boxes, "tissue": None if height_mm is None else plane}
    return {**HANDS[hands], "scene": scene}


@pytest.mark.needs("simulator")
@pytest.mark.parametrize(("hands", "tissue", "boxes"), some(PLANS, 11))
def test_all_doors_say_the_same_of_a_plan(
    trained: Service, hands: str, tissue: str, boxes: bool, skills, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = plan(trained, GOAL_MM, **asked(hands, tissue, boxes))
    job = trained.http.post("/playbacks", json={"plan": made["id"]}).json()["id"]
    trained.work()
    playback = trained.client.playback(trained.client.job(job)["result"]["playback"])
    line, report = playback["headline"], playback["report"]

    # the words are of one event, with its worlds and what it leaves out, or there is no probability
    counts = {
        None: None,
        "hand-over": "the complete plan succeeds",
        "clearance": "the motion stays within reach and clear",
    }
    assert line["event"] == counts[line["counts"]]
    assert (line["estimate"] is not None) == (line["probability"] is not None) == playback["feasible"]
    if playback["feasible"]:
        figures = f"{line['event']} in {line['probability']['count']} of {line['probability']['of']} worlds"
        assert figures in line["estimate"] and line["estimate"] in line["text"]
        assert ("tissue" in line["not_judged"]) == (tissue == "none")
        assert ("the stated obstacles" in line["not_judged"]) == boxes
        assert ("a hand-off" in line["not_judged"]) == (hands == "no hand-off")
        assert all(words in line["estimate"] for words in line["not_judged"] if len(line["not_judged"]) > 1)
    else:
        assert report["failure_sentence"] in line["text"]
        assert not re.search(r"worlds|probab|succeed", line["text"])
    no_arm = hands == "no hand-off"
    assert no_arm <= all(not cost["error"].startswith("registration") for cost in report["estimate"]["costs"])

    page, listed = (text_of(trained.http.get(at).text) for at in (f"/pages/plans/{made['id']}", "/pages/plans"))
    assert line["text"] in page
    assert (line["estimate"] or "not feasible") in listed
    verdict = page[page.index("The verdict") :]
    assert bool(re.search("[0-9] of 1000", verdict)) == playback["feasible"]
    beside = report["scene"]
    if beside is not None:
        arms = [one for one in beside["nearest"] if one["body"] != "needle"]
        row = verdict[verdict.index("Arms from tissue") :]
        assert (f"{arms[0]['link']} to {arms[0]['part']}" if arms else "over ") in row[: row.index("must be kept")]
        assert ("Needle from tissue" in verdict) == (tissue != "none")

    traces = [one["name"] for one in trained.http.get(f"/timelines/plans/{made['id']}").json()["timeline"]["traces"]]
    passing = {"hand-over": "The pass succeeds", "clearance": "The pass stays within reach and clear"}
    of_odds = [name for name in traces if name.startswith("The pass")]
    assert [name.partition(",")[0] for name in of_odds] == ([passing[line["counts"]]] if playback["feasible"] else [])

    monkeypatch.setenv("SKILLS_DATABASE_URL", trained.url)
    settings.cache_clear()
    code, said = skills("play", made["id"])
    assert (code, " ".join(said.split())) == (
        0 if playback["feasible"] else 1,
        " ".join([line["text"], *line["under"]]),
    )

    bag = trained.http.get(
        f"/plans/{made['id']}/trajectory",
        params={"handoff": "none"} if not made["hands_over"] else {},
        headers={"Accept": "application/zip"},
    )
    assert bag.is_success <= playback["feasible"]
    if bag.is_success:
        readme = zipfile.ZipFile(io.BytesIO(bag.content)).read("README.txt").decode()
        assert f"Not judged: {', '.join(line['not_judged'])}." in readme
        assert made["description"] in readme
        assert (line["hand_over"] is None) == (line["counts"] != "hand-over")
        assert (line["hand_over"] or "") in " ".join(readme.split())


def test_style_and_card_state_up_to_where_an_action_is_optimal(still: Service) -> None:
    for path in (f"/pages/styles/kestrel/{cases.SUTURE}", f"{POLICY}/versions/1/card"):
        assert OPTIMAL in text_of(still.http.get(path, headers={"Accept": "text/html"}).text), path
