from skills.serving import environment
from skills.settings import Settings


def test_settings_reach_the_child_whatever_the_environment_says(monkeypatch):
    given = Settings(database_url="sqlite:////somewhere/else.sqlite", lease_s=3.5, workers=1)
    monkeypatch.setenv("SKILLS_LEASE_S", "9")
    monkeypatch.setenv("SKILLS_SERVER", "http://elsewhere")
    assert "SKILLS_SERVER" not in environment(given)
    for name, value in environment(given).items():
        monkeypatch.setenv(name, value)
    monkeypatch.delenv("SKILLS_SERVER")
    assert Settings() == given
