"""The list of proposed hand-offs in a real browser: corrected, accepted for a new surgeon, rejected, opened again."""

from pathlib import Path

import pytest
from playwright.sync_api import expect

from skills.client import Client
from skills.seeds.recordings import sample_recordings
from tests.e2e.browsers import axe, browsing, visiting
from tests.e2e.conftest import running
from tests.library import cases
from tests.waiting import END_S

FIVE = next(one for one in sample_recordings() if len(one.segments) == 5)
expect.set_options(timeout=1000 * END_S)


def test_proposals_are_decided_one_after_the_other(tmp_path: Path) -> None:
    with running(tmp_path, workers=0) as service, Client(service.url) as client, browsing() as browser:
        recording = client.add_recording(FIVE.data).id
        with visiting(browser, service.url, view=False, phone=True) as tab:
            page = tab.page
            tab.open("/pages/recordings")
            page.get_by_role("link", name="Open proposals").click()
            items = page.locator(".proposals > li")
            expect(items).to_have_count(5)
            expect(page.locator(".proposals polyline")).to_have_count(5)
            assert axe(page) == [] and tab.too_wide() <= 0
            tab.shoot("proposals")
            items.nth(0).get_by_role("button", name="Accept").click()
            expect(items.nth(0).get_by_role("alert")).to_contain_text("Choose the suture type")
            cut = page.get_by_role("form", name="For the proposals that you accept")
            cut.get_by_label("Suture type").select_option(cases.SUTURE)
            cut.get_by_label("Surgeon").select_option("a new surgeon")
            cut.get_by_label("Pseudonym, never a name").fill("osprey")
            ends = items.nth(0).get_by_label("Ends, s")
            ends.fill(str(float(ends.input_value()) - 0.1))
            items.nth(0).get_by_label("Outcome").select_option("recovery")
            items.nth(0).get_by_label("Why, for a recovery or a failure").fill("The needle slipped.")
            items.nth(0).get_by_role("button", name="Accept").click()
            expect(items.nth(0).get_by_role("status")).to_contain_text("Cut for osprey")
            expect(items.nth(1).get_by_role("button", name="Accept")).to_be_focused()
            page.keyboard.press("Enter")  # for the same surgeon
            expect(items.nth(1).get_by_role("status")).to_contain_text("Cut for osprey")
            items.nth(2).get_by_label("Note, if rejected").fill("Only regrasped.")
            items.nth(2).get_by_role("button", name="Reject").click()
            expect(items.nth(2).get_by_role("status")).to_contain_text("Rejected")
            page.get_by_label("State").select_option("rejected")
            page.get_by_role("button", name="Show").click()
            expect(items).to_have_count(1)
            expect(items).to_contain_text("Only regrasped.")
            items.get_by_role("button", name="Open it again").click()
            expect(page.get_by_role("heading", name="No proposal fits these choices")).to_be_visible()
        found = client.proposals(recording=recording)
        assert [one.state for one in found] == ["accepted", "accepted", "open", "open", "open"]
        assert {one.surgeon for one in found[:2]} == {"osprey"}
        assert (found[0].outcome, found[0].note) == ("recovery", "The needle slipped.")
        demo = client.demo(found[0].demo or "")
        assert demo.end_s == pytest.approx(found[0].end_s - 0.1, abs=0.02)
