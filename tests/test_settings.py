"""Settings for network access: beyond loopback only encrypted, and only with a key or an authenticating proxy."""

from pathlib import Path

import pytest
from pydantic import ValidationError

from skills.db.session import Database
from skills.errors import BadSettings, Conflict
from skills.library.people.keys import create_key
from skills.serving import refuse_keyless, serve
from skills.settings import Settings, settings
from tests import backends

SECRET = "s" * 32
TLS = {"tls_cert": Path("cert.pem"), "tls_key": Path("key.pem")}


@pytest.mark.parametrize(
    "how",
    [
        {},
        {"host": "localhost"},
        {"host": "::1"},
        {"host": "127.8.8.8"},
        {"host": "10.1.2.3", **TLS},
        {"host": "skills.lab", "tls_by_proxy": True},
        {"host": "0.0.0.0", "hosts": "skills.lab", **TLS},
        {"proxy_header": "X-Remote-User", "proxy_secret": SECRET},
    ],
)
def test_these_go_together(how: dict[str, object]):
    Settings(**how).check_address()


@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"host": "0.0.0.0"}, "must not be sent unencrypted"),
        ({"host": "::"}, "must not be sent unencrypted"),
        ({"host": "10.1.2.3"}, "SKILLS_TLS_BY_PROXY"),
        ({"host": "skills.lab"}, "SKILLS_TLS_CERT"),
        ({"host": "127.0.0.1.nip.io"}, "reachable from other machines"),
        ({"tls_cert": Path("cert.pem")}, "belong together"),
        ({"host": "0.0.0.0", **TLS}, "SKILLS_HOSTS"),
        ({"host": "::", "tls_by_proxy": True}, "SKILLS_HOSTS"),
        ({"proxy_header": "X-Remote-User"}, "any client could send that header"),
        ({"proxy_header": "X-Remote-User", "proxy_secret": "short"}, "at least 32"),
    ],
)
def test_these_do_not(how: dict[str, object], why: str):
    with pytest.raises(BadSettings, match=why):
        Settings(**how).check_address()


def test_roles_are_those_of_the_ladder_and_secrets_are_not_shown():
    with pytest.raises(ValidationError):
        Settings(proxy_role="god")
    shown = repr(Settings(api_key="skills_secret", proxy_secret=SECRET))
    assert "skills_secret" not in shown
    assert SECRET not in shown


def test_beyond_loopback_the_service_starts_only_with_a_key_or_a_proxy(tmp_path: Path):
    url = backends.fresh("sqlite", tmp_path)
    outside = Settings(database_url=url, host="skills.lab", tls_by_proxy=True)
    with pytest.raises(Conflict, match=r"no valid one.*[Aa]sk the operator of the service for a key"):
        refuse_keyless(outside)
    refuse_keyless(Settings(database_url=url))
    refuse_keyless(outside.model_copy(update={"proxy_header": "X-Remote-User"}))
    database = Database(url)
    with database.writing() as session:
        create_key(session, "anna", "admin", "local")
    database.close()
    refuse_keyless(outside)


def test_samples_are_loaded_at_start_only_by_a_local_service(tmp_path: Path):
    url = f"sqlite:///{tmp_path / 'skills.sqlite'}"
    for how in (TLS, {"host": "skills.lab", "tls_by_proxy": True}):
        with pytest.raises(BadSettings, match="only for a service on this machine"):
            serve(Settings(database_url=url, **how), samples=True)
    assert list(tmp_path.iterdir()) == []


def test_a_misspelt_choice_is_suggested(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKILLS_LOG_LEVEL", "warn")
    settings.cache_clear()
    with pytest.raises(BadSettings) as refused:
        settings()
    settings.cache_clear()
    assert "Did you mean 'warning'?" in str(refused.value)


def test_an_invalid_variable_is_named_without_repeating_its_value(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("SKILLS_PORT", "70000")
    monkeypatch.setenv("SKILLS_WORKERS", "s3cret")
    with pytest.raises(BadSettings, match=r"SKILLS_PORT: .*65535; SKILLS_WORKERS: .*integer") as refused:
        settings.__wrapped__()
    assert "s3cret" not in str(refused.value)


def test_the_default_database_follows_xdg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("SKILLS_DATABASE_URL", raising=False)
    monkeypatch.setattr(Path, "home", lambda: tmp_path / "home")
    home, named = (tmp_path / f"{one}/suture-skills/skills.sqlite" for one in ("home/.local/share", "data"))

    def place() -> str:
        return Settings().database_url.removeprefix("sqlite:///")

    monkeypatch.delenv("XDG_DATA_HOME", raising=False)
    assert place() == str(home)
    monkeypatch.setenv("XDG_DATA_HOME", "relative")  # the XDG specification has such a path ignored
    assert place() == str(home)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert place() == str(named)
