"""Pages in a real browser: figures that agree, parts that are renewed, and nothing replaced that was not meant."""

from pathlib import Path

import pytest
from playwright.sync_api import Browser, Page, expect

from skills.api.pages.filters import share
from skills.client import Client
from skills.seeds.recordings import sample_recordings
from tests.e2e.browsers import Watched, visiting
from tests.e2e.conftest import Service, running
from tests.library import cases
from tests.waiting import END_S

FIVE = next(one for one in sample_recordings() if len(one.segments) == 5)
IMPORTED = 'import(document.querySelector(`script[src$="/site.js"]`).src.replace("site.js", "%s"))'
expect.set_options(timeout=1000 * END_S)


def of_module(page: Page, name: str, function: str) -> object:
    """Return what a function makes of a module of the pages."""
    return page.evaluate(f"async () => ({function})(await {IMPORTED % name})")


def test_a_share_is_the_same_number_wherever_a_page_shows_it(browser: Browser, service: Service) -> None:
    """Before, 0.29 was 28 % in the view of a style, and 0.58 was 57 %."""
    with visiting(browser, service.url, view=False) as tab:
        tab.open("/pages/catalogue")
        every = "({percent}) => Array.from({length: 1001}, (_, n) => percent(n / 1000))"
        told = of_module(tab.page, "site.js", every)
        assert isinstance(told, list) and len(told) == 1001
        compared = [n for n in range(1001) if n % 10 != 5]  # the two languages round x.5 % to either side
        assert [told[n] for n in compared] == [share(n / 1000, 0) for n in compared]
        nearly = "({percent}) => [percent(0.9999), percent(0.9999, 1)]"
        assert of_module(tab.page, "site.js", nearly) == ["> 99 %", "> 99.9 %"]


def test_a_limit_is_seen_also_where_every_distance_is_below_it(browser: Browser, service: Service) -> None:
    with visiting(browser, service.url, view=False) as tab:
        tab.open("/pages/catalogue")
        ranges = of_module(
            tab.page,
            "plot.js",
            """({Plot}) => [5, -3, 1.5].map((limit) =>
                 Plot.prototype.extent.call({lines: [{values: [1, 2], width: 1, k: 0, limit}]}))""",
        )
        for limit, (low, high) in zip((5, -3, 1.5), ranges, strict=True):
            assert low <= limit <= high and low <= 1 and high >= 2


def test_a_motion_that_ends_early_is_placed_by_its_last_position(browser: Browser, service: Service) -> None:
    """Before, a motion beside another was moved by NaN, and vanished, if one of them ended before its recording."""
    with visiting(browser, service.url, view=False) as tab:
        tab.open("/pages/catalogue")
        ends = "({lastOf}) => [[1, 2, 3, 4, 5, 6, NaN, NaN, NaN], [NaN, NaN, NaN, 4, 5, 6]].map(lastOf)"
        assert of_module(tab.page, "scene.js", ends) == [3, 3]


def test_a_part_with_the_focus_is_renewed_once_it_is_left(browser: Browser, tmp_path: Path) -> None:
    """Before, a list of jobs whose last job ended while it had the focus showed it as queued for ever."""
    with running(tmp_path, workers=0) as service, Client(service.url) as client:
        client.put_surgeon("kestrel")
        client.add_demo(cases.hand_off(), surgeon="kestrel", suture=cases.SUTURE)
        job = client.train("kestrel", cases.SUTURE)
        with visiting(browser, service.url, view=False) as tab:
            tab.open("/pages/jobs")
            jobs = tab.page.locator("#jobs")
            jobs.get_by_role("link", name=job.id).focus()
            client.cancel(job.id)
            for _ in range(2):
                with tab.page.expect_response("**/pages/jobs"):
                    pass
            expect(jobs).to_contain_text("queued")
            tab.page.evaluate("document.activeElement.blur()")
            expect(jobs).to_contain_text("cancelled")


def test_a_new_surgeon_never_replaces_one_and_is_asked_for_again(browser: Browser, tmp_path: Path) -> None:
    """Before, a pseudonym that was taken meanwhile lost its skill level and its consent."""
    with running(tmp_path, workers=0) as service, Client(service.url) as client:
        client.add_recording(FIVE.data)
        tab = Watched(browser, service.url, view=False)
        tab.open("/pages/proposals")
        client.put_surgeon("osprey", skill_level="expert", consent={"uses": ["training"]})
        cut = tab.page.get_by_role("form", name="For the proposals that you accept")
        cut.get_by_label("Suture type").select_option(cases.SUTURE)
        cut.get_by_label("Surgeon").select_option("a new surgeon")
        pseudonym = cut.get_by_label("Pseudonym, never a name")
        pseudonym.fill("osprey")
        first = tab.page.locator(".proposals > li").nth(0)
        first.get_by_role("button", name="Accept").click()
        expect(first.get_by_role("alert")).not_to_be_empty()
        found = client.surgeon("osprey")
        assert (found.skill_level, found.consent is None, client.demos()) == ("expert", False, [])
        tab.page.reload()
        expect(pseudonym).to_be_visible()
        tab.context.close()


@pytest.mark.parametrize("body", ["<html>", ""])
def test_an_answer_that_is_none_of_ours_ends_an_upload(browser: Browser, service: Service, body: str) -> None:
    """Before, the page of an upload stayed locked."""
    with visiting(browser, service.url, view=False) as tab:
        tab.page.route("**/recordings/preview?*", lambda asked: asked.fulfill(status=200, body=body))
        tab.open("/pages/recordings/new")
        tab.page.locator("#file").set_input_files({"name": "a.csv", "mimeType": "text/csv", "buffer": cases.hand_off()})
        tab.page.get_by_role("button", name="Preview").click()
        expect(tab.page.locator("#upload-said")).not_to_be_empty()
        expect(tab.page.get_by_role("button", name="Preview")).to_be_enabled()
