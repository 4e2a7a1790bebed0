"""`DELETE /recordings/{recording}`: for its uploader or an admin, and not while demonstrations depend on it."""

from tests.api.keyed import As, key
from tests.api.service import CSV, KESTREL, Service, assert_problem
from tests.library import cases


def send(whom: As, shift: float, query: str = "") -> str:
    how = {"content": cases.hand_off((shift, 0.0, 0.0)), "headers": {"Content-Type": CSV}}
    answer = whom("POST", f"/recordings{query}", **how)
    assert answer.status_code == 201, answer.text
    return answer.json()["id"]


def test_its_uploader_or_an_admin_deletes_a_recording(here: Service):
    anna, bert, admin = (
        As(here, key(here, owner, role))
        for owner, role in (("anna", "uploader"), ("bert", "releaser"), ("ada", "admin"))
    )
    sent, other, cut = send(anna, 0.0), send(anna, 2.5), send(anna, 5.0)
    assert_problem(bert("DELETE", f"/recordings/{sent}"), 403, "not-allowed")
    assert anna("DELETE", f"/recordings/{sent}").status_code == 204
    assert_problem(anna("DELETE", f"/recordings/{sent}"), 404, "not-found")
    assert admin("DELETE", f"/recordings/{other}").status_code == 204
    assert anna("POST", f"/recordings/{cut}/demos", json=KESTREL).status_code == 201
    for whom in (anna, admin):
        assert "erase=true" in assert_problem(whom("DELETE", f"/recordings/{cut}"), 409)["detail"]


def test_a_recording_that_was_uploaded_as_a_surgeons_goes_with_the_surgeon(here: Service):
    local = As(here, key(here, "ada", "admin"))
    sent, nobodys = send(local, 0.0, "?surgeon=kestrel"), send(local, 2.5)
    answer = local("POST", "/recordings?surgeon=nobody", content=cases.hand_off(), headers={"Content-Type": CSV})
    assert_problem(answer, 404, "not-found")
    assert local("DELETE", "/surgeons/kestrel").status_code == 204
    assert local("GET", f"/recordings/{sent}").status_code == 404
    assert local("GET", f"/recordings/{nobodys}").status_code == 200
