"""The atlas in a real browser: without scripts, in dark mode, with the keyboard, on a phone."""

import re

import pytest
from playwright.sync_api import expect

from skills.client import Client
from tests.comparison.cohort import cohort
from tests.e2e.browsers import Watched, browsing
from tests.e2e.conftest import Service
from tests.library import cases, cohorts

DRAWN = cohort(1, surgeons=2, sessions=2)


@pytest.mark.nightly  # 12 s of processor time; by day test_page opens an atlas
def test_an_atlas_is_drawn_and_says_whose_style_one_is(service: Service, client: Client) -> None:
    for one, surgeon in enumerate(DRAWN.surgeons.tolist()):
        name, csv = cohorts.name(surgeon), cohorts.hand_off(DRAWN, one)
        client.put_surgeon(name)
        client.add_demo(csv, surgeon=name, suture=cases.SUTURE, media_type="text/csv", session=str(one), grid="fit")
    with browsing() as browser:
        desk, phone = Watched(browser, service.url, dark=True), Watched(browser, service.url, phone=True)
        desk.open("/")
        desk.page.get_by_role("link", name="The atlas of Simple running").click()
        desk.page.wait_for_url(re.compile(f"/pages/atlas/{cases.SUTURE}"))
        chart = desk.page.get_by_role("img", name=re.compile("4 demonstrations as points"))
        expect(chart.locator("circle.medoid")).to_have_count(2)
        desk.page.get_by_text("All demonstrations").focus()
        desk.page.get_by_role("link", name="Recognise").first.press("Enter")
        expect(desk.page.locator("#whose")).to_contain_text("stored as surgeon-0's")
        expect(desk.page.locator("#whose .advice")).to_contain_text("Set-up and day are confounded with the surgeon")
        desk.page.get_by_label("Size").select_option("scaled to one size")
        desk.page.get_by_role("button", name="Compare").press("Enter")
        expect(desk.page.locator("main .lead")).to_contain_text("lengths of start to goal")
        desk.shoot("atlas-dark")
        phone.open(f"/pages/atlas/{cases.SUTURE}")
        assert phone.too_wide() == 0
        phone.shoot("atlas-phone")
        for tab in (desk, phone):
            tab.context.close()
            assert (tab.complaints, tab.foreign()) == ([], [])
