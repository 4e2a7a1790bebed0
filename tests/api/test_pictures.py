"""Pictures over HTTP: first pending with a reason, then available, each with its content type and ETag."""

import pytest

from skills.simulation import film
from tests.api.service import GOAL_MM, KESTREL, Service, assert_problem

TYPES = {
    "picture": "image/png",
    "animation_mp4": "video/mp4",
    "animation_gif": "image/gif",
    "joints": "image/png",
    "clearance": "image/png",
}
BEGINS = {"image/png": b"\x89PNG\r\n\x1a\n", "image/gif": b"GIF89a"}


@pytest.mark.needs("simulator")
def test_pictures_are_drawn_after_the_verdict_and_erased_with_the_surgeon(
    trained: Service, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(film, "FRAMES", 3)
    monkeypatch.setattr(film, "FRAMES_PER_PASS", 3)
    client = trained.client
    plan = client.plan(**KESTREL, suture_points=[{"position_mm": GOAL_MM}], handoff="none")
    client.play(plan["id"])
    [verdict] = trained.work()
    playback = client.playback(verdict["result"]["playback"])
    links = playback["pictures"]
    assert set(links) == set(TYPES)

    # the verdict exists, the pictures do not yet
    [job] = [one for one in trained.http.get("/jobs").json()["items"] if one["state"] == "queued"]
    assert job["kind"] == "pictures"
    assert trained.http.get(links["picture"]).status_code == 200
    for name in set(TYPES) - {"picture"}:
        problem = assert_problem(trained.http.get(links[name]), 404, "not-drawn-yet")
        assert f"/jobs/{job['id']}" in problem["detail"]
    answer = trained.http.post(f"/playbacks/{playback['id']}/pictures")
    assert (answer.status_code, answer.json()["id"]) == (202, job["id"])

    # the pictures exist
    [done] = trained.work()
    assert done["state"] == "succeeded", done["error"]
    assert client.draw(playback["id"])["id"] == client.wait(client.draw(playback["id"]))["id"] == job["id"]
    tags = set()
    for name, media_type in TYPES.items():
        answer = trained.http.get(links[name])
        assert (answer.status_code, answer.headers["content-type"]) == (200, media_type)
        assert answer.content.startswith(BEGINS.get(media_type, b"\0\0\0"))
        tag = answer.headers["etag"]
        tags.add(tag)
        assert trained.http.get(links[name], headers={"If-None-Match": tag}).status_code == 304
        assert trained.http.get(links[name], headers={"If-None-Match": '"other"'}).status_code == 200
    assert len(tags) == len(TYPES)
    assert client.animation(playback["id"])[4:8] == b"ftyp"
    assert client.animation(playback["id"], "gif").startswith(b"GIF89a")
    assert client.plot(playback["id"], "joints") != client.plot(playback["id"], "clearance")

    # the pictures are deleted
    client.erase_surgeon("kestrel")
    assert trained.counts()["playback_pictures"] == 0
    for link in links.values():
        assert_problem(trained.http.get(link), 404, "not-found")


def test_pictures_of_a_playback_that_there_is_not_are_not_found(still: Service):
    for name in ("picture.png", "animation.mp4", "animation.gif", "joints.png", "clearance.png"):
        assert_problem(still.http.get(f"/playbacks/{'0' * 64}/{name}"), 404, "not-found")
    assert_problem(still.http.post(f"/playbacks/{'0' * 64}/pictures"), 404, "not-found")
    assert_problem(still.http.get(f"/playbacks/{'0' * 64}/animation.webm"), 404)
