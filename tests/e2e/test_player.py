"""The player in a real browser: a minute of two arms, scrubbed, played, compared, and with marked parts."""

import re

import pytest
from playwright.sync_api import Browser, Page, expect

from skills.client import Client
from skills.formats.bag_writer import write_mcap
from skills.seeds.recordings import sample_recordings
from tests.e2e.browsers import Watched, axe, colours
from tests.e2e.conftest import Service
from tests.verification.timelines import two_arms
from tests.waiting import END_S, crowded

SAMPLES = {one.surgeon: one for one in sample_recordings() if one.suture == "simple-running"}
FRAMES_HZ, FIRST_S = 20.0, 1.0
expect.set_options(timeout=1000 * END_S)
# Drag the slider for two seconds, and return the frames a second in which the view was painted.
SCRUBBED_HZ = """async () => {
  const [at, view] = ["at", "view"].map((id) => document.getElementById(id));
  const before = Number(view.dataset.painted), began = performance.now();
  for (let n = 0; performance.now() - began < 2000; n += 1) {
    at.value = (n * 0.37) % at.max;
    at.dispatchEvent(new Event("input"));
    await new Promise((wake) => requestAnimationFrame(wake));
  }
  return (1000 * (Number(view.dataset.painted) - before)) / (performance.now() - began);
}"""


@pytest.fixture(scope="module")
def player(service: Service, client: Client) -> str:
    """Return the path of the player of a minute of two arms."""
    return f"/pages/player/recordings/{client.add_recording(write_mcap(two_arms())).sha256}"


@pytest.fixture(scope="module")
def beside(client: Client) -> str:
    """Return the path of the player of two surgeons."""
    demos = {}
    for surgeon in ("kestrel", "heron"):
        sample = SAMPLES[surgeon]
        client.put_surgeon(surgeon)
        start_s, end_s = sample.segments[0]
        where = {"surgeon": surgeon, "suture": sample.suture}
        demos[surgeon] = client.add_demo(sample.data, **where, start_s=start_s, end_s=end_s).id
    return f"/pages/player/demos/{demos['kestrel']}?beside=demos/{demos['heron']}"


def when_ready(tab: Watched, path: str) -> Page:
    tab.open(path)
    expect(tab.page.locator("#player")).to_have_attribute("data-ready", "true")
    return tab.page


def now(page: Page) -> float:
    return float(page.locator("#at").input_value())


def close(tab: Watched) -> None:
    tab.context.close()
    assert tab.complaints == [] and tab.foreign() == []


def test_a_minute_of_two_arms_is_scrubbed_played_and_moved_by_keys(
    browser: Browser, service: Service, player: str
) -> None:
    tab = Watched(browser, service.url)
    page = when_ready(tab, player)
    first_s = page.evaluate("performance.getEntriesByName('first picture')[0].startTime") / 1000
    slow, frames_hz = crowded(), page.evaluate(SCRUBBED_HZ)
    print(f"first picture after {first_s:.2f} s, {frames_hz:.0f} frames a second, machine slower by {slow:.1f}")
    assert frames_hz * max(slow, crowded()) >= FRAMES_HZ
    assert first_s <= FIRST_S * 3 * max(slow, crowded()), "both the service and the browser wait for processors"
    page.locator("h1").click()
    page.keyboard.press("Home")
    assert now(page) == 0
    for key, at in (("ArrowRight", 0.1), ("Shift+ArrowRight", 1.1), ("ArrowLeft", 1.0), ("End", 59.995)):
        page.keyboard.press(key)
        assert now(page) == pytest.approx(at, abs=1e-6), key
    page.keyboard.press("Home")
    page.keyboard.press(".")
    expect(page.get_by_label("Speed")).to_have_value("2")
    page.keyboard.press(" ")
    page.wait_for_function("() => document.getElementById('at').value > 0.5")
    page.keyboard.press(" ")
    stopped = now(page)
    page.evaluate("new Promise((wake) => setTimeout(wake, 60))")
    assert now(page) == stopped
    expect(page.get_by_role("checkbox", name="Start and end")).not_to_be_checked()
    page.locator(".chart").first.scroll_into_view_if_needed()
    chart = page.locator(".chart").first.bounding_box()
    assert chart is not None
    page.mouse.click(chart["x"] + 44 + (chart["width"] - 52) / 2, chart["y"] + 40)
    assert now(page) == pytest.approx(30, abs=0.2)
    close(tab)


def test_two_surgeons_are_in_step_by_time_or_by_their_way(browser: Browser, service: Service, beside: str) -> None:
    tab = Watched(browser, service.url, view=False)
    page = when_ready(tab, beside)
    page.locator("h1").click()
    page.keyboard.press("End")
    by_time = page.locator("#time").inner_text()
    page.get_by_label("In step by").select_option("way")
    page.locator("h1").click()
    page.keyboard.press("End")
    assert page.locator("#time").inner_text() != by_time, "heron takes longer, and ends with kestrel by the way"
    speeds = page.locator("#now tr td").all_inner_texts()
    assert all(float(one.split()[0]) < 8 for one in speeds), "both have arrived"
    with page.expect_download() as saved:
        page.get_by_role("button", name="MCAP for Foxglove").click()
    assert saved.value.suggested_filename.endswith("-to-look-at.mcap")
    page.get_by_label("Beside it").select_option("")
    page.get_by_role("button", name="Show", exact=True).click()
    expect(page.locator("#player")).to_have_attribute("data-ready", "true")
    assert page.locator("#step").count() == 0
    close(tab)


def test_an_executed_plan_has_its_tube_and_efforts(browser: Browser, service: Service, client: Client) -> None:
    sample = SAMPLES["kestrel"]
    client.put_surgeon(sample.surgeon)
    start_s, end_s = sample.segments[0]
    client.add_demo(sample.data, surgeon=sample.surgeon, suture=sample.suture, start_s=start_s, end_s=end_s)
    client.wait(client.train(sample.surgeon, sample.suture, release=True), timeout_s=END_S)
    plan = client.plan(sample.surgeon, sample.suture, [(5.0, 55.0, -120.0)], handoff="none")
    client.wait(client.play(plan.id, servo={"velocities": False}), timeout_s=END_S)
    tab = Watched(browser, service.url)
    page = when_ready(tab, f"/pages/player/plans/{plan.id}")
    expect(page.get_by_role("checkbox", name="Predicted error of the tip")).to_be_checked()
    expect(page.locator("#now")).to_contain_text("as executed")
    expect(page.locator("#now")).to_contain_text("Effort of yaw")
    expect(page.locator("#charts")).to_contain_text("Efforts as executed")
    tab.shoot("player-executed")
    close(tab)


def test_a_sign_of_loading_stands_until_the_motion_is_there(browser: Browser, service: Service, player: str) -> None:
    tab = Watched(browser, service.url, view=False)
    held = []
    tab.page.route("**/timelines/**", lambda route: held.append(route))
    tab.page.goto(service.url + player, wait_until="commit")
    expect(tab.page.get_by_role("status").filter(has_text="is being read")).to_be_visible()
    expect(tab.page.get_by_role("button", name="Play")).to_be_disabled()
    while tab.page.locator("#player[data-ready]").count() == 0:
        for route in held:
            route.continue_()
        held.clear()
        tab.page.wait_for_timeout(20)
    expect(tab.page.locator("#loading")).to_have_count(0)
    close(tab)


def test_a_marked_part_is_shown_where_it_is_and_sought(browser: Browser, service: Service, beside: str) -> None:
    tab = Watched(browser, service.url, view=False)
    page = when_ready(tab, beside)
    start = float(page.locator("#time").inner_text().split()[0])
    unmarked = colours(page.locator(".chart").first.screenshot())
    page = when_ready(tab, f"{beside}&mark={start + 0.5:.2f}-{start + 1:.2f}&mark={start + 2:.2f}-{start + 2.5:.2f}")
    assert now(page) == pytest.approx(0.5, abs=0.01)
    assert colours(page.locator(".chart").first.screenshot()) > unmarked
    page.get_by_role("button", name=re.compile("^2 ")).click()
    assert now(page) == pytest.approx(2.0, abs=0.01)
    assert axe(page) == []
    close(tab)


SCREENS = [("desk", "light"), ("desk", "dark"), ("phone", "light"), ("phone", "dark")]


@pytest.mark.nightly  # four windows, drawn in software
@pytest.mark.parametrize(("window", "theme"), SCREENS)
def test_the_player_fits_every_window(
    browser: Browser, service: Service, player: str, beside: str, window: str, theme: str
) -> None:
    tab = Watched(browser, service.url, phone=window == "phone", dark=theme == "dark")
    for name, path in (("minute", player), ("beside", beside)):
        page = when_ready(tab, path)
        assert tab.too_wide() <= 0
        tab.shoot(f"player-{name}-{window}-{theme}")
        assert axe(page) == []
    close(tab)
