"""Keys of the client: the requests that carry one, and those that never do."""

import httpx2 as httpx
import pytest

from skills.client import AsyncClient, Client, Problem, UnprotectedKey
from skills.settings import settings
from tests.client.peers import BOTH, Script, Time, answer

KEY = "skills_1234abcd_not-a-real-one"


@pytest.fixture
def own_key(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKILLS_API_KEY", KEY)
    settings.cache_clear()
    yield KEY
    settings.cache_clear()


@pytest.mark.parametrize("made", BOTH)
def test_a_key_is_shown_with_every_request_and_in_no_other_way(made):
    script = Script(answer({"items": [], "next": None}))
    made(script, Time(), api_key=KEY)("surgeons")
    made(script, Time(), api_key=KEY)("get_json", "/surgeons")
    assert [one.headers["authorization"] for one in script.asked] == [f"Bearer {KEY}"] * 2
    assert not any(KEY in str(one.url) for one in script.asked)


@pytest.mark.parametrize("kind", [Client, AsyncClient])
@pytest.mark.parametrize("server", ["http://10.0.0.5:8000", "http://skills.example.org", "http://127.example.org"])
def test_it_never_travels_in_the_open_unless_asked_for(kind, server):
    with pytest.raises(UnprotectedKey, match="https://"):
        kind(server, api_key=KEY)
    assert kind(server, api_key=KEY, plain_http=True)
    assert kind(server)


@pytest.mark.parametrize(
    "server",
    ["http://127.0.0.1:8000", "http://127.8.8.8", "http://[::1]:8000", "http://localhost:8000", "https://example.org"],
)
def test_it_may_go_to_this_machine_and_where_nobody_can_read_it(server):
    assert Client(server, api_key=KEY)


def test_the_key_of_the_settings_is_shown_to_addresses_alone(own_key):
    with pytest.raises(UnprotectedKey):
        Client("http://10.0.0.5:8000")
    assert Client("http://10.0.0.5:8000", api_key="")
    script = Script(answer({"items": [], "next": None}))
    with Client(httpx.Client(base_url="http://10.0.0.5", transport=script)) as client:
        client.surgeons()
    assert "authorization" not in script.asked[0].headers
    with Client("http://127.0.0.1:8000") as client:
        assert "with a key" in repr(client)


def test_nobody_sees_it_in_a_notebook():
    with Client("http://127.0.0.1:8000", api_key=KEY) as client:
        assert repr(client) == "<Client of http://127.0.0.1:8000, with a key>"
    assert repr(AsyncClient("https://example.org")) == "<AsyncClient of https://example.org>"


def test_it_is_not_taken_along_to_where_an_answer_points():
    script = Script(httpx.Response(307, headers={"location": "http://elsewhere.example.org/"}))
    with pytest.raises(Problem, match="307"):
        BOTH[0](script, Time(), api_key=KEY)("surgeons")
    assert [one.url.host for one in script.asked] == ["127.0.0.1"]


def test_no_proxy_stands_between_a_client_and_its_own_machine(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("HTTP_PROXY", "http://proxy.example.org:3128")
    monkeypatch.delenv("NO_PROXY", raising=False)
    near, far = Client("http://127.0.0.1:8000", api_key=KEY), Client("http://10.0.0.5:8000")
    assert (near.http.trust_env, far.http.trust_env) == (False, True)
