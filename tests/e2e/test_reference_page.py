"""The page of the calls, drawn by Swagger UI, in a real browser."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest
from playwright.sync_api import Browser, Locator, Route, expect

from skills.client import Client
from skills.db.session import Database
from skills.library.people.keys import create_key
from tests.e2e.browsers import Watched, visiting
from tests.e2e.conftest import Service, running
from tests.waiting import END_S

PREFIX = "/lab/skills"
expect.set_options(timeout=1000 * END_S)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with running(tmp_path_factory.mktemp("service"), workers=0) as started:
        yield started


@pytest.fixture(scope="module")
def url(service: Service, client: Client) -> str:
    """Return the URL of a service with one surgeon."""
    client.put_surgeon("kestrel")
    return service.url


def try_out(tab: Watched, call: str) -> Locator:
    """Execute a call without parameters on the page of the calls; returns its response."""
    block = tab.page.locator(f"[id$={call}]")
    block.locator(".opblock-summary-control").click()
    block.get_by_role("button", name="Try it out").click()
    block.get_by_role("button", name="Execute").click()
    return block.locator(".live-responses-table .response")


@pytest.mark.nightly  # a page that takes 5 s of processor time; by day tests/api reads it
@pytest.mark.parametrize(
    "name", ["desk", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("desk-dark", "phone"))]
)
def test_a_call_is_tried_out_on_the_page_of_the_calls(browser: Browser, url: str, name: str) -> None:
    with visiting(browser, url, phone="phone" in name, dark="dark" in name) as tab:
        tab.open("/docs")
        answer = try_out(tab, "list_surgeons")
        expect(tab.page.get_by_text("Loading the calls")).to_have_count(0)
        expect(answer.locator(".response-col_status")).to_contain_text("200")
        expect(answer).to_contain_text(f'"surgeon": "{"kestrel"}"')
        assert tab.too_wide() == 0
        tab.shoot(f"docs-{name}")


@pytest.mark.nightly  # as above, with a service of its own
@pytest.mark.parametrize("scheme", ["bearer", pytest.param("header", marks=pytest.mark.nightly)])
def test_a_call_with_a_key_is_tried_out_behind_a_prefix(browser: Browser, tmp_path: Path, scheme: str) -> None:
    serving = running(tmp_path, root_path=PREFIX, workers=0)
    with serving as service, closing(Database(f"sqlite:///{service.database}")) as database:
        with database.writing() as session:
            _, key = create_key(session, "anna", "reader", "local")
        with visiting(browser, service.url) as tab:
            tab.page.route(f"**{PREFIX}/**", without_prefix)
            tab.open(f"{PREFIX}/docs")
            tab.page.get_by_role("button", name="Authorize").first.click()
            credentials = tab.page.locator(".auth-container").filter(has_text=f"{scheme} (")
            credentials.locator("input").fill(key)
            credentials.get_by_role("button", name="Apply credentials").click()
            credentials.get_by_role("button", name="Close").click()
            answer = try_out(tab, "list_surgeons")
            expect(answer.locator(".response-col_status")).to_contain_text("200")
            assert f"{service.url}{PREFIX}/surgeons?limit=50" in tab.asked


def without_prefix(route: Route) -> None:
    """Pass a request on as a reverse proxy does that takes its prefix off."""
    route.continue_(url=route.request.url.replace(PREFIX, "", 1))
