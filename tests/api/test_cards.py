"""The policy card: the same facts for people and for programs, from verified values only."""

import base64
import hashlib
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from sqlalchemy import text

from skills.api.pages import drawings
from skills.api.responses import json_of
from skills.db.session import Database
from skills.library.policies.cards import card_of as card_of_version
from skills.library.policies.versions import find_version
from skills.packing import sha256
from skills.schemas.cards import PolicyCard
from tests import backends
from tests.api.html import Html
from tests.api.service import CSV, GOAL_MM, KESTREL, POLICY, Service, assert_problem
from tests.library import cases

CARD = f"{POLICY}/versions/1/card"
PAGE = {"Accept": "text/html"}
DOCUMENT = Path(__file__).parents[2] / "docs" / "policy-card.md"
NASTY = "<script>alert(1)</script>&\"'`{{ 7*7 }}"


def card_of(service: Service, path: str = CARD) -> dict:
    answer = service.http.get(path)
    assert answer.status_code == 200, answer.text[:500]
    return answer.json()


def page_of(service: Service, path: str = CARD) -> str:
    answer = service.http.get(path, headers=PAGE)
    assert answer.status_code == 200, answer.text[:500]
    return answer.text


def leaves(value: object) -> Iterator[object]:
    """Yield every single value of a card."""
    if isinstance(value, dict | list):
        for one in value.values() if isinstance(value, dict) else value:
            yield from leaves(one)
    else:
        yield value


# ---- content ----------------------------------------------------------------------------------------------------


def test_a_card_reports_its_policy_demonstration_and_recording(still: Service):
    card = card_of(still)
    policy, demo = still.http.get(POLICY).json(), still.http.get("/demos").json()["items"][0]
    assert PolicyCard.model_validate(card).policy.sha256 == policy["sha256"]
    assert {name: card["policy"][name] for name in ("arm", "frame", "instrument", "grid", "start_mm", "goal_mm")} == {
        name: policy[name] for name in ("arm", "frame", "instrument", "grid", "start_mm", "goal_mm")
    }
    assert {one["name"]: one["value"] for one in card["metrics"]} == {
        name: value for name, value in policy["metrics"].items() if name not in ("tie_break", "path_states")
    }
    learner = card["learner"]
    assert (learner["kind"], learner["settings"], learner["seed"]) == (policy["learner"], policy["settings"], 0)
    (told,) = card["demonstrations"]
    assert told["sha256"] == demo["id"]
    assert told["report"] == demo["report"]
    assert told["recording"]["sha256"] == demo["recording"] == sha256(cases.hand_off())
    assert told["recording"]["size_bytes"] == len(cases.hand_off())
    assert card["surgeon"]["skill_level"] == "expert"
    assert card["suture_type"]["name"] == "Simple running"
    assert "not a medical device" in card["use"]
    assert any("how closely a real arm follows" in one for one in card["what_it_is_not"])
    assert "0.65 mm" in card["limits"]["tip_accuracy"]


def test_the_card_by_digest_is_the_card_by_version(still: Service):
    card = still.http.get(CARD)
    by_digest = still.http.get(f"/policy-versions/{card.json()['policy']['sha256']}/card")
    assert by_digest.content == card.content
    assert by_digest.headers["etag"] == card.headers["etag"]


def test_anybody_can_compute_the_digests_of_a_card_again(still: Service):
    """The test uses the recording's file and Python's own json as `how` describes, and none of our code."""
    chain = {link["what"]: link for link in card_of(still)["lineage"]["chain"]}
    assert list(chain) == ["recording", "demonstration", "reward map", "policy"]
    assert chain["recording"]["sha256"] == hashlib.sha256(cases.hand_off()).hexdigest()
    for what in ("demonstration", "policy"):
        written = json.dumps(chain[what]["digest_of"], sort_keys=True, separators=(",", ":"))
        assert hashlib.sha256(written.encode()).hexdigest() == chain[what]["sha256"]
    assert chain["demonstration"]["digest_of"]["recording"] == chain["recording"]["sha256"]
    assert chain["policy"]["digest_of"][0]["demos"] == [chain["demonstration"]["sha256"]]
    demo = chain["demonstration"]["sha256"]
    assert chain["reward map"]["sha256"] == still.http.get(f"/demos/{demo}/reward-map").json()["sha256"]


def test_the_check_in_the_documents_finds_a_changed_card(
    still: Service, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    (check,) = re.findall("```python\n(.*?)```", DOCUMENT.read_text(), re.DOTALL)
    card, file = still.http.get(CARD).text, tmp_path / "card.json"
    monkeypatch.chdir(tmp_path)
    file.write_text(card)
    exec(check, {})
    file.write_text(card.replace('"seed": 0', '"seed": 1'))
    with pytest.raises(AssertionError, match="policy"):
        exec(check, {})


def test_a_card_counts_every_start_once_in_all_and_by_layer(trained: Service):
    trained.train(learner={"kind": "cell-q-learning", "episodes": 20})
    for version in (1, 2):
        coverage = card_of(trained, f"{POLICY}/versions/{version}/card")["coverage"]
        for name in ("follow", "reach_otherwise", "do_not_reach"):
            assert sum(layer[name] for layer in coverage["layers"]) == coverage[name]
            assert coverage["shares"][name] == coverage[name] / 1331
        assert coverage["follow"] + coverage["reach_otherwise"] == coverage["starts_reaching_goal"]
        assert sum(coverage["shares"].values()) == pytest.approx(1)
    assert coverage["do_not_reach"] > 0, "the second one fails from somewhere, so that this tells something"
    assert [layer["z_mm"] for layer in coverage["layers"]] == list(np.arange(-140.0, -89.0, 5.0))


def test_the_citation_names_the_digests_and_balances_its_braces(still: Service):
    card = card_of(still)
    bibtex = card["citation"]["bibtex"]
    assert bibtex.startswith("@misc{kestrel-simple-running-v1-")
    assert bibtex.count("{") == bibtex.count("}")
    for link in card["lineage"]["chain"]:
        assert (link["sha256"] in bibtex) == (link["what"] != "reward map")
    assert card["policy"]["created_at"][:4] in card["citation"]["text"]


# ---- the page ---------------------------------------------------------------------------------------------------


@pytest.mark.nightly  # a page; by day its numbers are tested in JSON
def test_every_number_of_the_page_is_in_the_json(trained: Service):
    trained.train(learner={"kind": "cell-q-learning", "episodes": 20})
    for version in (1, 2):
        path = f"{POLICY}/versions/{version}/card"
        said = list(leaves(card_of(trained, path)))
        numbers = [abs(one) for one in said if isinstance(one, int | float)]
        words = re.sub(r"(:\d\d)\.\d+Z", r"\1", " ".join(one for one in said if isinstance(one, str)))
        in_words = {float(one) for one in re.findall(r"\d+(?:\.\d+)?", words)}
        shown = re.findall(r"\d+(?:,\d{3})*(?:\.\d+)?", Html(page_of(trained, path)).text)
        assert len(shown) > 100
        for one in shown:
            value, digits = float(one.replace(",", "")), len(one.partition(".")[2])
            rounded = any(abs(value - number) <= 0.5000001 * 10**-digits for number in numbers)
            assert rounded or value in in_words, one


def test_the_page_is_one_file_that_runs_nothing_and_fetches_nothing(still: Service):
    answer = still.http.get(CARD, headers=PAGE)
    document = Html(answer.text)
    assert not {"script", "img", "link", "iframe", "object", "a", "form", "use"} & set(document.names)
    names = [name for name, _ in document.attributes]
    assert not [name for name in names if name in ("href", "src", "style") or name.startswith("on")]
    assert not re.search(r"https?://|@import", answer.text)
    style = re.search("<style>(.*?)</style>", answer.text, re.DOTALL)[1]
    assert set(re.findall(r"url\((.)", style)) == {"#"}, "the patterns of the drawing, which are in the file"
    allowed = base64.b64encode(hashlib.sha256(style.encode()).digest()).decode()
    policy = f"default-src 'none'; style-src 'sha256-{allowed}'"
    assert answer.headers["content-security-policy"] == f"{policy}; frame-ancestors 'none'"
    assert ("content", policy) in document.attributes
    assert answer.headers["content-disposition"] == 'inline; filename="kestrel-simple-running-v1-card.html"'


def test_the_page_shows_the_demonstration_and_every_layer_of_the_grid(still: Service):
    html = page_of(still)
    assert html.count('class="layer"') == 11
    assert html.count('class="from"') == html.count('class="to"') == 2, "one in the key, one where it is"
    assert {f"z {z} mm" for z in range(-140, -89, 5)} <= set(re.findall(r"z -\d+ mm", html))
    for kind in drawings.KINDS:
        assert f'<pattern id="{kind}"' in html


def test_what_people_call_things_is_no_mark_up(trained: Service):
    suture = {"name": NASTY, "also_called": [NASTY], "family": NASTY, "description": NASTY}
    assert trained.http.put(f"/suture-types/{cases.SUTURE}", json=suture).status_code == 200
    assert trained.http.put("/surgeons/kestrel", json={"protocol": NASTY}).status_code == 200
    assert card_of(trained)["suture_type"]["name"] == NASTY
    html = page_of(trained)
    assert "<script" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;/script&gt;&amp;") == 6, (
        "name twice, family, others, description, protocol"
    )
    assert "{{ 7*7 }}" in html, "and nobody has computed it"


@pytest.mark.parametrize(
    ("accept", "kind"),
    [
        ("*/*", "application/json"),
        ("application/json, text/html", "application/json"),
        ("text/html,application/xhtml+xml,application/xml;q=0.9,*/*;q=0.8", "text/html; charset=utf-8"),
    ],
)
def test_a_browser_gets_the_page_and_a_program_the_json(still: Service, accept: str, kind: str):
    answer = still.http.get(CARD, headers={"Accept": accept})
    assert answer.headers["content-type"] == kind
    assert "Accept" in answer.headers["vary"]


def test_a_card_in_another_form_or_of_no_version_is_refused(still: Service):
    assert_problem(still.http.get(CARD, headers={"Accept": "image/png"}), 415)
    assert_problem(still.http.get(f"{POLICY}/versions/9/card"), 404, "not-found")
    assert_problem(still.http.get(f"/policy-versions/{'0' * 64}/card"), 404, "not-found")


# ---- the state, and the ETag that follows it --------------------------------------------------------------------


def tags(service: Service) -> tuple[str, str]:
    return tuple(service.http.get(CARD, headers=accept).headers["etag"] for accept in ({}, PAGE))


def test_the_same_state_gives_the_same_bytes_and_304(still: Service):
    for accept in ({}, PAGE):
        first, second = (still.http.get(CARD, headers=accept) for _ in range(2))
        assert first.content == second.content
        assert first.headers["etag"] == f'"{hashlib.sha256(first.content).hexdigest()}"'
        have = still.http.get(CARD, headers={**accept, "If-None-Match": first.headers["etag"]})
        assert (have.status_code, have.content, have.headers["etag"]) == (304, b"", first.headers["etag"])
    assert len(set(tags(still))) == 2, "a page and its JSON are different bytes"


def test_a_release_a_withdrawal_and_a_plan_change_the_card_and_its_tag(trained: Service):
    seen = [tags(trained)]
    status = card_of(trained)["status"]
    assert (status["released_now"], status["served_now"]["version"], len(status["releases"])) == (True, 1, 1)
    trained.train(seed=5, release=True)
    status = card_of(trained)["status"]
    assert (status["released_now"], status["served_now"]["version"]) == (False, 2)
    assert "version 2 is released now" in status["in_words"]
    seen.append(tags(trained))
    trained.http.delete(f"{POLICY}/release")
    status = card_of(trained)["status"]
    assert status["served_now"] is None
    assert status["releases"][0]["withdrawn_at"] is not None
    seen.append(tags(trained))
    body = KESTREL | {"version": 1, "suture_points": [{"position_mm": GOAL_MM}], "handoff": "none"}
    assert trained.http.post("/plans", json=body).status_code == 201
    assert card_of(trained)["lineage"]["rests_on_it"]["plans"] == 1
    assert "1 plan follows" in page_of(trained)
    seen.append(tags(trained))
    for both in zip(*seen, strict=True):
        assert len(set(both)) == len(seen)


def test_a_withdrawn_demonstration_is_told_in_plain_words(trained: Service):
    assert "was withdrawn" not in page_of(trained)
    demo = card_of(trained)["demonstrations"][0]["sha256"]
    assert trained.http.delete(f"/demos/{demo}").status_code == 204
    card = card_of(trained)
    assert card["demonstrations"][0]["state"] == "withdrawn"
    assert (card["status"]["released_now"], card["status"]["releasable"]) == (False, False)
    text = " ".join(Html(page_of(trained)).text.split())
    assert "The demonstration was withdrawn. Withdrawn on" in text
    assert "do not use this policy" in text
    assert "It cannot be released: its demonstration was withdrawn." in text


def test_consent_is_told_in_words(trained: Service):
    assert "No consent is recorded" in page_of(trained)
    consent = {"uses": ["training", "export"], "until": "2031-05-04"}
    trained.http.put("/surgeons/kestrel", json={"consent": consent})
    assert card_of(trained)["surgeon"]["consent"] == consent
    assert "Covers training, export, until 2031-05-04; other uses are refused." in page_of(trained)


def test_a_refused_version_has_a_card_that_says_why(trained: Service):
    trained.train(learner={"kind": "cell-q-learning", "episodes": 20})
    path = f"{POLICY}/versions/2/card"
    card = card_of(trained, path)
    certified = card["certificate"]["refused_because"]
    assert card["status"]["refused_because"] == [one["text"] for one in certified] != []
    text = " ".join(Html(page_of(trained, path)).text.split())
    for reason in card["status"]["refused_because"]:
        assert reason in text
    assert "the cell alone, as in the paper" in text


def test_what_is_erased_is_on_no_card(trained: Service):
    sha = card_of(trained)["policy"]["sha256"]
    trained.http.put("/surgeons/heron", json={})
    data = cases.hand_off()
    how = {"params": {"surgeon": "heron", "suture": cases.SUTURE}, "headers": {"Content-Type": CSV}}
    assert trained.http.post("/demos", content=data, **how).status_code == 201
    assert trained.http.delete("/surgeons/kestrel").status_code == 204
    for headers in ({}, PAGE):
        assert_problem(trained.http.get(CARD, headers=headers), 410, "erased")
        assert_problem(trained.http.get(f"/policy-versions/{sha}/card", headers=headers), 404)


def test_both_databases_write_the_same_card(tmp_path: Path):
    """Except for times, the same recording, settings and seed give the same digests on every database."""
    cards = []
    for backend in backends.BACKENDS:
        url = backends.fresh(backend, tmp_path)
        database = Database(url)
        cases.add_surgeon(database, consent={"uses": ["training"], "until": None})
        cases.add_demo(database)
        cases.train(database, release=True)
        cases.add_plan(database)
        with database.reading() as session:
            facts = card_of_version(session, find_version(session, **KESTREL, version=1)).facts.model_dump()
        cards.append(re.sub(r"\d{4}-\d\d-\d\dT[0-9:.]+Z", "", json_of(facts).decode()))
        database.close()
        backends.drop(url)
    assert cards[0] == cards[1]
    assert json.loads(cards[0])["status"]["released_now"] is True


# ---- damage -----------------------------------------------------------------------------------------------------


OTHER = "replace({0}, substr({0}, 1, 8), '00000000')"
BYTE = "CAST(substr({0}, 1, 90) || x'00' || substr({0}, 92) AS BLOB)"
DAMAGE = (
    ("policy_versions", "manifest", "replace({0}, '\"dtw_total_mm\": 0.0', '\"dtw_total_mm\": 0.1')"),
    ("policy_versions", "learnt", BYTE),
    ("policy_versions", "covered", BYTE),
    ("policy_versions", "sha256", OTHER),
    ("policy_versions", "releasable", "not {0}"),
    ("demonstrations", "demo", BYTE),
    ("demonstrations", "path", BYTE),
    ("demonstrations", "sha256", OTHER),
    ("demonstrations", "end_s", "{0} + 1"),
    ("demonstrations", "hysteresis", "0.25"),
    ("reward_maps", "sha256", OTHER),
    ("reward_maps", "map", BYTE),
    ("recordings", "sha256", OTHER),
    ("recordings", "size_bytes", "{0} + 1"),
    ("recording_chunks", "data", BYTE),
)


def test_a_damaged_value_gives_no_card(trained: Service):
    """Each value is damaged after a good card was served, so that no cache may hide the damage."""
    for table, column, damage in DAMAGE:
        assert trained.http.get(CARD).status_code == 200, "all that was damaged before is whole again"
        with trained.database.reading() as session:
            whole = session.scalars(text(f"SELECT {column} FROM {table}")).one()
        trained.tamper(f"UPDATE {table} SET {column} = {damage.format(column)}")
        for headers in ({}, PAGE):
            problem = assert_problem(trained.http.get(CARD, headers=headers), 503, "corrupt")
            assert "from a backup" in problem["detail"], (table, column)
        trained.tamper(f"UPDATE {table} SET {column} = :whole", whole=whole)
