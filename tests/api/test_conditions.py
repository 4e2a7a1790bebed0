"""Lists, filters and conditional requests."""

import re
from collections.abc import Iterator

import pytest

from tests.api.service import CSV, GOAL_MM, KESTREL, POLICY, Service, assert_problem, copy_of_trained, serving
from tests.library import cases


@pytest.fixture
def addresses(still: Service) -> list[str]:
    """Return the addresses that can be read without the simulator; the others behave in the same way."""
    demo = still.client.demos()[0]
    plan = still.client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")["id"]
    job = still.http.get("/jobs").json()["items"][0]["id"]
    return [
        "/surgeons", "/surgeons/kestrel", "/suture-types", f"/suture-types/{cases.SUTURE}", "/demos", "/jobs",
        *(f"/demos/{demo['id']}{part}" for part in ("", "/path", "/reward-map", "/report", "/recording")),
        f"/recordings/{demo['recording']}", f"/jobs/{job}", "/policies", POLICY, f"{POLICY}/versions",
        f"{POLICY}/versions/1", f"{POLICY}/versions/1/card", f"/plans/{plan}", f"/plans/{plan}/trajectory",
        f"/plans/{plan}/comparison?demo={demo['id']}",
    ]  # fmt: skip


def test_what_a_client_has_already_is_not_sent_again(still: Service, addresses: list[str]):
    for address in addresses:
        first = still.http.get(address)
        tag = first.headers["etag"]
        assert re.fullmatch('"[0-9a-f]{64}"', tag), address
        for names in (tag, f'"other", {tag}', f"W/{tag}", "*"):
            again = still.http.get(address, headers={"If-None-Match": names})
            assert (again.status_code, again.content) == (304, b""), (address, names)
            assert again.headers["etag"] == tag
        other = still.http.get(address, headers={"If-None-Match": '"other"'})
        assert (other.status_code, other.content) == (200, first.content), address


def test_a_change_of_what_was_seen_last_is_made_and_any_other_refused(service: Service):
    for address, old, new in (
        ("/surgeons/kestrel", {"skill_level": "novice"}, {"skill_level": "expert"}),
        ("/suture-types/mine", {"name": "Mine", "family": "f"}, {"name": "Ours", "family": "f"}),
    ):
        put = service.http.put
        assert_problem(put(address, json=old, headers={"If-Match": "*"}), 412, "precondition-failed")
        assert put(address, json=old, headers={"If-None-Match": "*"}).status_code == 201
        assert_problem(put(address, json=old, headers={"If-None-Match": "*"}), 412)
        seen = service.http.get(address).headers["etag"]
        assert put(address, json=new, headers={"If-Match": seen}).status_code == 200
        assert_problem(put(address, json=old, headers={"If-Match": seen}), 412)
        empty = {"If-Match": "", "If-None-Match": '"other"'}
        assert put(address, json=new, headers=empty).status_code == 200, "an empty header is no condition"
        assert service.http.get(address).json().items() >= new.items()


def test_only_what_was_seen_last_is_taken_away(trained: Service):
    demo = f"/demos/{trained.client.demos()[0]['id']}"
    for address in (demo, "/surgeons/kestrel"):
        before = trained.counts()
        assert_problem(trained.http.delete(address, headers={"If-Match": '"other"'}), 412)
        assert trained.counts() == before
        seen = trained.http.get(address).headers["etag"]
        assert trained.http.delete(address, headers={"If-Match": seen}).status_code == 204


def test_a_release_that_was_overtaken_is_not_withdrawn_unseen(trained: Service):
    seen = trained.http.get(POLICY).headers["etag"]
    trained.train(learner={"kind": "value-iteration"}, release=True)
    assert_problem(trained.http.delete(f"{POLICY}/release", headers={"If-Match": seen}), 412, "precondition-failed")
    now = trained.http.get(POLICY)
    assert now.json()["version"] == 2
    assert trained.http.delete(f"{POLICY}/release", headers={"If-Match": now.headers["etag"]}).status_code == 204
    assert_problem(trained.http.get(POLICY), 404)


# ---- lists ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def many(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """Yield a service with five surgeons and three demonstrations of kestrel, one withdrawn, for tests that read."""
    with serving(copy_of_trained(tmp_path_factory.mktemp("many"))) as service:
        fill(service)
        yield service


def fill(trained: Service) -> None:
    for slug in ("heron", "kestrel-2", "plover", "wren"):
        trained.client.put_surgeon(slug, skill_level="novice" if slug == "wren" else "intermediate")
    for shift in (1.0, 2.0):
        trained.client.add_demo(cases.hand_off((0.0, 0.0, shift)), media_type=CSV, **KESTREL)
    trained.client.withdraw_demo(trained.client.demos()[0]["id"])


def ids(service: Service, address: str, name: str = "id") -> list[str]:
    return [one[name] for one in service.http.get(address).json()["items"]]


@pytest.mark.parametrize(
    "address", ["/surgeons", "/suture-types", "/demos", "/jobs", "/policies", f"{POLICY}/versions"]
)
@pytest.mark.parametrize("limit", [1, 2, 200])
def test_the_pages_of_a_list_are_the_list(many: Service, address: str, limit: int):
    whole = many.http.get(address, params={"limit": 200}).json()["items"]
    found, answer = [], many.http.get(address, params={"limit": limit})
    while True:
        said = answer.json()
        assert len(said["items"]) <= limit
        found += said["items"]
        link = re.fullmatch(r'<(.*)>; rel="next"', answer.headers.get("link", ""))
        assert (said["next"] is None) == (link is None)
        if link is None:
            break
        following = answer.request.url.join(link[1])
        assert following.params["cursor"] == str(said["next"])
        answer = many.http.get(following)
    assert found == whole
    assert whole


def test_lists_are_narrowed_by_what_is_asked(many: Service):
    assert ids(many, "/surgeons?search=KESTREL", "surgeon") == ["kestrel", "kestrel-2"]
    assert ids(many, "/surgeons?search=_", "surgeon") == ids(many, "/surgeons?search=%25", "surgeon") == []
    assert ids(many, "/surgeons?skill_level=novice", "surgeon") == ["wren"]
    assert ids(many, "/surgeons?search=e&limit=1&cursor=heron", "surgeon") == ["kestrel"]
    assert "horizontal-mattress" in ids(many, "/suture-types?search=mattress", "suture")
    assert "simple-running" not in ids(many, "/suture-types?search=mattress", "suture")
    everything = ids(many, "/demos")
    assert (len(everything), len(ids(many, "/demos?active=true"))) == (3, 2)
    assert ids(many, "/demos?active=false") == everything[:1]
    recording = many.client.demo(everything[1])["recording"]
    assert ids(many, f"/demos?recording={recording}") == [everything[1]]
    assert ids(many, "/demos?surgeon=heron") == []
    assert len(ids(many, "/jobs?kind=training")) == 1
    assert ids(many, "/jobs?kind=playback") == ids(many, "/jobs?state=failed&kind=training") == []
    assert ids(many, "/policies?surgeon=kestrel", "surgeon") == ["kestrel"]
    assert ids(many, f"/policies?surgeon=heron&suture={cases.SUTURE}", "surgeon") == []
    for unknown in ("/demos?surgeon=nobody", "/policies?suture=none", f"/demos?recording={'0' * 64}"):
        assert_problem(many.http.get(unknown), 404, "not-found")
