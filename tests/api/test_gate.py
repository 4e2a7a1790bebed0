"""Authentication: keys, sign-ins and their tokens, proxy headers, host names, cross-origin pages, rate limits."""

import asyncio
import gc
import hashlib
import logging
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any
from weakref import ref

import pytest
from sqlalchemy import event, text

from skills.api.app import ALWAYS
from skills.api.gate import COOKIE, PROXY_SECRET, Gate
from skills.api.rate_limits import BAD_AT_ONCE, Bucket
from skills.library.people.keys import revoke_key
from tests import backends
from tests.api.keyed import As, copy_of_told, key, routes
from tests.api.service import CSV, KESTREL, Service, assert_problem, serving
from tests.library import cases

PAGE = {"Accept": "text/html,application/xhtml+xml;q=0.9"}
SECRET = "p" * 32


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    with serving(backends.fresh("sqlite", tmp_path)) as service:
        service.http.follow_redirects = False
        yield service


def remember_nothing(service: Service) -> None:
    """Clear the cached keys, as a second of waiting would."""
    service.app.state.access.forget()


# ---- keys


def test_local_requests_need_a_key_once_the_first_key_was_made(service: Service):
    assert service.http.put("/surgeons/kestrel", json={}).status_code == 201
    text = key(service, "anna", "reader")
    assert_problem(service.http.get("/surgeons"), 401, "not-signed-in")
    with service.database.writing() as session:
        revoke_key(session, text.split("_")[1], "local")
    remember_nothing(service)
    assert service.http.get("/surgeons").status_code == 401  # no key is left, which does not open the service again


def test_a_key_is_shown_as_a_bearer_or_as_x_api_key_and_in_no_other_way(service: Service):
    text = key(service, "anna", "reader")
    for headers in ({"Authorization": f"Bearer {text}"}, {"authorization": f"bearer  {text}"}, {"X-API-Key": text}):
        assert service.http.get("/surgeons", headers=headers).status_code == 200
    wrong: list[dict[str, str]] = [
        {"Authorization": f"Basic {text}"},
        {"Authorization": text},
        {"Authorization": "Bearer"},
        {"Authorization": f"Bearer {text}", "X-API-Key": text},
        {"Cookie": f"{COOKIE}={text}"},
        {"X-API-Key": hashlib.sha256(text.encode()).hexdigest()},
    ]
    for headers in wrong:
        answer = service.http.get("/surgeons", headers=headers)
        assert_problem(answer, 401, "not-signed-in")
        assert answer.headers["www-authenticate"].startswith("Bearer")
    assert service.http.get(f"/surgeons?api_key={text}&key={text}&access_token={text}").status_code == 401
    twice = [("X-API-Key", text), ("X-API-Key", text)]
    assert service.http.get("/surgeons", headers=twice).status_code == 403


def test_no_key_and_no_cookie_is_ever_in_a_log_or_in_the_database(
    service: Service, caplog: pytest.LogCaptureFixture, tmp_path: Path
):
    caplog.set_level(logging.DEBUG)
    good, bad = key(service, "anna", "admin"), f"skills_0badc0de_{'x' * 43}"
    for shown in (good, bad):
        service.http.get("/surgeons", headers={"X-API-Key": shown})
        service.http.get("/nowhere", headers={"Authorization": f"Bearer {shown}"})
        service.http.post("/sign-in", data={"key": shown})
    cookie = service.http.cookies[COOKIE]
    said = caplog.text + "".join(str(record.__dict__) for record in caplog.records if "httpx" not in record.name)
    stored = b"".join(file.read_bytes() for file in tmp_path.iterdir())
    for shown, secret in ((good, good.split("_", 2)[2]), (bad, bad.split("_", 2)[2]), (cookie, cookie)):
        assert len(secret) == 43  # the secret itself may hold "_"
        assert shown not in said
        assert secret.encode() not in stored


def test_an_admin_makes_and_revokes_keys_and_only_creation_shows_a_secret(service: Service):
    admin = As(service, key(service, "anna", "admin"))
    assert admin("PUT", "/surgeons/heron", json={}).status_code == 201
    asked = {"owner": "bob", "role": "uploader", "surgeons": ["heron"], "expires_at": "2999-01-01T00:00:00Z"}
    made = admin("POST", "/keys", json=asked)
    assert (made.status_code, made.headers["cache-control"]) == (201, "no-store")
    about = made.json()
    bob = As(service, about.pop("secret"))
    assert [one["surgeon"] for one in bob("GET", "/surgeons").json()["items"]] == ["heron"]
    listed = admin("GET", "/keys").json()["items"]
    assert listed[1] == about
    assert about["created_by"] == "anna"
    assert_problem(admin("POST", "/keys", json=asked | {"surgeons": ["nobody"]}), 404, "not-found")
    assert_problem(admin("POST", "/keys", json=asked | {"expires_at": "2999-01-01T00:00:00"}), 422, "invalid-request")
    assert_problem(admin("POST", "/keys", json=asked | {"state": "active"}), 422, "invalid-request")
    assert_problem(admin("POST", "/keys", json={"owner": "local", "role": "admin"}), 422, "bad-input")
    assert admin("DELETE", f"/keys/{about['key']}").json()["state"] == "revoked"
    assert bob("GET", "/surgeons").status_code == 401
    assert_problem(admin("DELETE", "/keys/00000000"), 404, "not-found")


# ---- pages


def signed_in(service: Service, role: str = "uploader", **form: str) -> str:
    """Sign in with a new key, and return the token that the page gives to its scripts."""
    answer = service.http.post("/sign-in", data={"key": key(service, "anna", role), **form})
    assert answer.status_code == 303, answer.text
    page = service.http.get("/", headers=PAGE)
    assert page.status_code == 200
    return re.findall('name="csrf-token" content="([0-9a-f]{64})"', page.text)[0]


def test_a_page_leads_to_the_sign_in_and_back_and_a_call_does_not(service: Service):
    text = key(service, "anna", "reader")
    assert service.http.get("/", headers=PAGE).headers["location"] == "/sign-in"
    sent = service.http.get("/pages/jobs?state=queued&x=a%2Fb", headers=PAGE)
    assert (sent.status_code, sent.headers["location"]) == (
        303,
        "/sign-in?next=/pages/jobs%3Fstate%3Dqueued%26x%3Da%252Fb",
    )
    asking = service.http.get(sent.headers["location"], headers=PAGE)
    assert asking.status_code == 200
    assert 'value="/pages/jobs?state=queued&amp;x=a%2Fb"' in asking.text
    form = {"key": f" {text}\n", "next": "/pages/jobs?state=queued"}
    assert service.http.post("/sign-in", data=form).headers["location"] == "/pages/jobs?state=queued"
    assert service.http.post("/surgeons", headers=PAGE).status_code == 403  # signed in, but without the token
    service.http.cookies.clear()
    assert service.http.get("/surgeons", headers={"Accept": "application/json, text/html"}).status_code == 401
    assert service.http.put("/surgeons/x", json={}, headers=PAGE).status_code == 401


@pytest.mark.parametrize(
    "where",
    ["https://evil.example/", "//evil.example", "/\\evil.example", "\\\\evil", "javascript:1", "/a\nb", "", "x"],
)
def test_the_way_back_is_never_another_site(service: Service, where: str):
    text = key(service, "anna", "reader")
    asking = service.http.get("/sign-in", params={"next": where})
    assert 'name="next" value="/"' in asking.text
    assert service.http.post("/sign-in", data={"key": text, "next": where}).headers["location"] == "/"


def test_the_cookie_is_http_only_same_site_and_secure_over_tls(service: Service):
    text = key(service, "anna", "reader")
    for origin, secure in ((None, False), ("http://localhost", False), ("https://localhost", True)):
        headers = {} if origin is None else {"Origin": origin}
        said = service.http.post("/sign-in", data={"key": text}, headers=headers).headers["set-cookie"]
        assert {"HttpOnly", "SameSite=strict", "Path=/", "Max-Age=43200"} <= set(said.split("; "))
        assert ("Secure" in said.split("; ")) == secure
        assert len(service.http.cookies[COOKIE]) == 43 or secure


def test_what_a_page_changes_carries_the_token_of_its_session(service: Service):
    token = signed_in(service, "admin")
    put = service.http.put
    assert_problem(put("/surgeons/heron", json={}), 403, "not-allowed")
    for wrong in ("", "0" * 64, token[:-1], token + "0", token.upper()):
        assert put("/surgeons/heron", json={}, headers={"X-CSRF-Token": wrong}).status_code == 403
    assert put("/surgeons/heron", json={}, headers={"X-CSRF-Token": token}).status_code == 201
    assert service.http.get("/surgeons/heron").status_code == 200
    others = signed_in(service, "admin")
    assert others != token
    assert put("/surgeons/heron", json={}, headers={"X-CSRF-Token": token}).status_code == 403
    assert put("/surgeons/heron", json={}, headers={"X-CSRF-Token": others}).status_code == 200


def test_signing_out_or_revoking_the_key_ends_the_session(service: Service):
    token = signed_in(service)
    cookie = service.http.cookies[COOKIE]
    assert service.http.post("/sign-out", data={"csrf": "0" * 64}).status_code == 403
    answer = service.http.post("/sign-out", data={"csrf": token})
    assert (answer.status_code, answer.headers["location"]) == (303, "/sign-in")
    assert COOKIE not in service.http.cookies
    assert service.http.get("/surgeons", headers={"Cookie": f"{COOKIE}={cookie}"}).status_code == 401
    signed_in(service)
    with service.database.writing() as session:
        session.execute(text("UPDATE keys SET revoked_at = created_at"))
    remember_nothing(service)
    assert service.http.get("/surgeons").status_code == 401


def test_a_sign_in_with_what_is_no_key_says_so_on_the_page(service: Service):
    own = service.app.state.access.own_key  # admits this process to its own service, and nobody else
    for wrong in ("", "letmein", f"skills_0badc0de_{'x' * 43}", own, "\N{GRINNING FACE}" * 40):
        answer = service.http.post("/sign-in", data={"key": wrong})
        assert (answer.status_code, 'role="alert"' in answer.text) == (401, True)
        assert COOKIE not in service.http.cookies
    assert service.http.post("/sign-in", content=b"k" * 5000).status_code == 413
    assert service.http.post("/sign-in", content=b"\xff\xfe=\xff&key=%ff").status_code == 401
    assert service.http.post("/sign-in", content=b"&".join(b"a=1" for _ in range(50))).status_code == 422


# ---- host names and cross-origin requests


@pytest.mark.parametrize(
    "host", ["evil.example", "evil.example:80", "localhost.evil.example", "", "127.0.0.1.nip.io", "[::2]"]
)
def test_a_name_that_is_not_ours_leads_nowhere(service: Service, host: str):
    for path in ("/surgeons", "/healthz", "/sign-in", "/"):
        assert_problem(service.http.get(path, headers={"Host": host}), 400, "wrong-host")


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:8000", "127.0.0.1:1234", "[::1]:8000", "[::1]"])
def test_the_names_of_this_machine_do(service: Service, host: str):
    assert service.http.get("/surgeons", headers={"Host": host}).status_code == 200


def test_further_names_are_those_of_the_settings(tmp_path: Path):
    url = backends.fresh("sqlite", tmp_path)
    with serving(url, host="10.1.2.3", hosts="skills.lab, other.lab, fd00::1", tls_by_proxy=True) as service:
        for host, status in (
            ("skills.lab", 200),
            ("Other.Lab:443", 200),
            ("10.1.2.3", 200),
            ("lab", 400),
            ("[fd00::1]:8", 200),
        ):
            assert service.http.get("/healthz", headers={"Host": host}).status_code == status
        assert service.http.get("/surgeons").status_code == 401  # beyond loopback, being local does not admit


@pytest.mark.parametrize(
    "headers",
    [
        {"Origin": "http://evil.example"},
        {"Origin": "null"},
        {"Origin": "http://localhost:3000"},
        {"Origin": "http://["},
        {"Sec-Fetch-Site": "cross-site"},
        {"Sec-Fetch-Site": "same-site"},
        {"Origin": "http://localhost", "Sec-Fetch-Site": "cross-site"},
    ],
)
def test_another_sites_page_changes_nothing(service: Service, headers: dict[str, str]):
    assert_problem(service.http.put("/surgeons/heron", json={}, headers=headers), 403, "not-allowed")
    assert_problem(service.http.post("/sign-in", data={"key": "x"}, headers=headers), 403, "not-allowed")
    admin = As(service, key(service, "anna", "admin"))
    assert admin("PUT", "/surgeons/heron", json={}, headers=headers).status_code == 403
    assert admin("GET", "/surgeons", headers=headers).json()["items"] == []


@pytest.mark.parametrize(
    "headers", [{}, {"Origin": "http://localhost", "Sec-Fetch-Site": "same-origin"}, {"Sec-Fetch-Site": "none"}]
)
def test_our_own_pages_and_programs_do(service: Service, headers: dict[str, str]):
    assert service.http.put("/surgeons/heron", json={}, headers=headers).status_code == 201


def test_responses_refuse_cross_origin_reads_and_carry_security_headers(service: Service):
    paths = {path for method, path, _ in routes(service) if method == "GET" and "{" not in path} | {"/nowhere"}
    for path in sorted(paths):
        for ask in (service.http.get, service.http.options):
            answer = ask(path, headers={"Origin": "http://evil.example", "Access-Control-Request-Method": "GET"})
            assert not [name for name in answer.headers if name.startswith("access-control")], path
            assert "frame-ancestors 'none'" in answer.headers["content-security-policy"]
            assert "unsafe-inline" not in answer.headers["content-security-policy"].partition("style-src")[0]
            assert answer.headers["referrer-policy"] in ("no-referrer", "same-origin")
            for name, value in ALWAYS:
                assert answer.headers.get_list(name.decode()) == [value.decode()], (path, name)


# ---- a proxy


def behind_proxy(tmp_path: Path, **settings: Any) -> Any:
    settings = {"proxy_header": "X-Remote-User", "proxy_secret": SECRET, "proxy_role": "uploader"} | settings
    return serving(backends.fresh("sqlite", tmp_path), **settings)


def test_a_proxy_that_shows_its_secret_says_who_asks(tmp_path: Path):
    with behind_proxy(tmp_path) as service:
        service.client.http.headers["X-API-Key"] = key(service, "anna", "admin")
        service.client.put_surgeon("kestrel")
        del service.client.http.headers["X-API-Key"]
        word = {"X-Remote-User": "dr.who@lab", PROXY_SECRET.decode(): SECRET}
        sent = service.http.post(
            "/demos", params=KESTREL, content=cases.hand_off(), headers=word | {"Content-Type": CSV}
        )
        assert sent.status_code == 201
        assert_problem(service.http.post("/plans", headers=word), 403, "not-allowed")  # only a trainer may
        with service.database.reading() as session:
            said = session.execute(text("SELECT actor FROM events WHERE object_kind = 'demonstration'")).scalars().all()
        assert said == ["dr.who@lab"]
        assert service.http.get("/", headers=word | PAGE).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"X-Remote-User": "anna"},
        {"X-Remote-User": "anna", PROXY_SECRET.decode(): ""},
        {"X-Remote-User": "anna", PROXY_SECRET.decode(): SECRET[:-1]},
        {"X-Remote-User": "anna", PROXY_SECRET.decode(): SECRET + "p"},
        {PROXY_SECRET.decode(): SECRET},
        {"X-Remote-User": "", PROXY_SECRET.decode(): SECRET},
        {"X-Remote-User": "local", PROXY_SECRET.decode(): SECRET},
        {"X-Remote-User": "a<script>", PROXY_SECRET.decode(): SECRET},
        {"X-Forwarded-User": "anna", PROXY_SECRET.decode(): SECRET},
    ],
)
def test_nobody_else_does_and_behind_a_proxy_nobody_is_local(tmp_path: Path, headers: dict[str, str]):
    with behind_proxy(tmp_path) as service:
        assert_problem(service.http.get("/surgeons", headers=headers), 401, "not-signed-in")
        if "X-Remote-User" in headers and headers.get(PROXY_SECRET.decode()) != SECRET:
            admin = headers | {"X-API-Key": key(service, "anna", "admin")}
            assert service.http.get("/surgeons", headers=admin).status_code == 401
        twice = [("X-Remote-User", "anna"), ("X-Remote-User", "bob"), (PROXY_SECRET.decode(), SECRET)]
        assert service.http.get("/surgeons", headers=twice).status_code == 403


def test_where_no_proxy_is_known_its_word_is_refused(service: Service):
    word = {"X-Remote-User": "anna", PROXY_SECRET.decode(): SECRET}
    assert_problem(service.http.get("/surgeons", headers=word), 401, "not-signed-in")


# ---- rate limits


def test_a_bucket_gives_what_it_holds_and_is_refilled_evenly():
    at = [0.0]
    bucket = Bucket(4, 2.0, lambda: at[0])
    assert [bucket.take(1) for _ in range(5)] == [0, 0, 0, 0, 0.5]
    assert bucket.take(3) == 1.5
    at[0] = 0.5
    assert [bucket.take(1), bucket.take(1)] == [0, 0.5]
    at[0] = 100.0
    assert [bucket.take(4), bucket.take(1)] == [0, 0.5]  # its capacity is four


def test_a_rate_limited_key_gets_retry_after_and_other_keys_are_unaffected(tmp_path: Path):
    with serving(backends.fresh("sqlite", tmp_path), key_requests_per_s=1.5) as service:
        anna, bob = As(service, key(service, "anna", "reader")), As(service, key(service, "bob", "reader"))
        answers = [anna("GET", "/surgeons") for _ in range(30)]
        limited = [one for one in answers if one.status_code == 429]
        assert len(limited) >= 10
        assert {one.status_code for one in answers} == {200, 429}
        assert_problem(limited[0], 429, "too-many")
        assert limited[0].headers["retry-after"] == "1"
        assert bob("GET", "/surgeons").status_code == 200


def test_a_key_sends_so_many_bytes_a_day(tmp_path: Path):
    data = cases.hand_off()
    with serving(copy_of_told(tmp_path), key_upload_bytes_per_day=2 * len(data)) as service:
        anna, bob = As(service, key(service, "anna", "uploader")), As(service, key(service, "bob", "uploader"))
        sent = [anna("POST", "/recordings", content=data, headers={"Content-Type": CSV}) for _ in range(3)]
        assert [one.status_code for one in sent] == [201, 200, 429]
        assert 0 < int(sent[2].headers["retry-after"]) <= 43_200
        assert anna("GET", "/surgeons").status_code == 200
        assert bob("POST", "/recordings", content=data, headers={"Content-Type": CSV}).status_code == 201


def test_an_owner_has_so_many_jobs_waiting_with_all_keys_together(tmp_path: Path):
    with serving(copy_of_told(tmp_path), key_jobs=2) as service:
        first, second = (As(service, key(service, "anna", "trainer")) for _ in range(2))
        asked = [ask("POST", "/trainings", json=KESTREL | {"seed": seed}) for seed, ask in ((7, first), (8, second))]
        assert [one.status_code for one in asked] == [202, 202]
        for path, body in (
            ("/trainings", KESTREL | {"seed": 9}),
            ("/retrainings", {}),
            ("/playbacks", {"plan": "0" * 64}),
        ):
            assert_problem(second("POST", path, json=body), 429, "too-many")
        other = As(service, key(service, "bob", "trainer"))
        assert other("POST", "/trainings", json=KESTREL | {"seed": 9}).status_code == 202
        assert first("DELETE", f"/jobs/{asked[0].json()['id']}").status_code == 200
        assert second("POST", "/trainings", json=KESTREL | {"seed": 10}).status_code == 202


def wrong(number: int) -> str:
    return f"skills_{number:08x}_{'x' * 43}"


def test_a_valid_key_gets_in_whatever_others_of_its_address_show(service: Service):
    known, new = (As(service, key(service, owner, "reader")) for owner in ("anna", "bob"))
    assert known("GET", "/surgeons").status_code == 200
    found = [As(service, wrong(one))("GET", "/surgeons").status_code for one in range(BAD_AT_ONCE + 3)]
    assert found == [401] * BAD_AT_ONCE + [429] * 3
    remember_nothing(service)  # as after any sign-in, sign-out and new key
    assert known("GET", "/surgeons").status_code == 200
    assert new("GET", "/surgeons").status_code == 200  # it was not cached before
    assert service.http.post("/sign-in", data={"key": key(service, "carol", "reader")}).status_code == 303


def test_200_wrong_keys_and_200_wrong_cookies_cost_few_look_ups(service: Service):
    anna = As(service, key(service, "anna", "reader"))
    asked: list[object] = []
    event.listen(service.app.state.access._asked.engine, "begin", asked.append)
    shown = [{"X-API-Key": wrong(one)} for one in range(200)] + [
        {"Cookie": f"{COOKIE}={one:043}"} for one in range(200)
    ]
    with ThreadPoolExecutor(100) as threads:
        found = list(threads.map(lambda one: service.http.get("/surgeons", headers=one).status_code, shown))
        assert set(found) == {401, 429}
    assert anna("GET", "/surgeons").status_code == 200
    assert len(asked) < len(shown) / 2, len(asked)


def test_a_repeated_wrong_key_is_looked_up_and_counted_once(service: Service):
    anna = As(service, key(service, "anna", "reader"))
    again = [As(service, wrong(1))("GET", "/surgeons").status_code for _ in range(BAD_AT_ONCE * 2)]
    assert set(again) == {401}
    assert As(service, wrong(2))("GET", "/surgeons").status_code == 401
    assert anna("GET", "/surgeons").status_code == 200


# ---- memory


class Mark:
    """An object that can be referenced weakly."""


def test_a_request_is_freed_without_the_garbage_collector(service: Service):
    """A reference cycle in every request would leave its memory to the collector, which then has work all the time."""
    passed_on: list[str] = []

    async def application(scope: dict[str, Any], *_: object) -> None:
        passed_on.append(scope["caller"].name)

    async def request() -> "ref[Mark]":
        mark = Mark()
        scope = {"type": "http", "method": "GET", "path": "/surgeons", "headers": [(b"host", b"localhost")]}
        state = service.app.state
        gate = Gate(application, state.access, state.settings, state.database.history)
        await gate(scope | {"mark": mark}, None, None)  # type: ignore[arg-type]
        return ref(mark)

    gc.disable()
    try:
        assert asyncio.run(request())() is None
    finally:
        gc.enable()
    assert passed_on == ["local"]
