"""The pages in a real browser: from a recording to a playback, without complaints or external addresses."""

import io
import json
import re
from collections.abc import Iterator
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from playwright.sync_api import Browser, Locator, expect

from skills.api.app import create_app
from skills.client import Client
from skills.seeds.recordings import sample_recordings
from skills.settings import Settings
from tests.api.service import GOAL_MM
from tests.e2e.browsers import Watched, axe, colours, visiting
from tests.e2e.conftest import Service, by_a_thread, running
from tests.formats import written
from tests.library import cases
from tests.waiting import END_S

SAMPLE = next(s for s in sample_recordings() if len(s.segments) > 1)
STYLE = f"{SAMPLE.surgeon}/{SAMPLE.suture}"
WORK_MS = 300_000  # for a training or a playback on a busy machine
expect.set_options(timeout=1000 * END_S)


@pytest.fixture(scope="module")
def url(service: Service, client: Client) -> str:
    """Return the URL of a service on which one style is released."""
    client.put_surgeon(SAMPLE.surgeon, skill_level="expert")
    start_s, end_s = SAMPLE.segments[0]
    client.add_demo(SAMPLE.data, surgeon=SAMPLE.surgeon, suture=SAMPLE.suture, start_s=start_s, end_s=end_s)
    client.wait(client.train(SAMPLE.surgeon, SAMPLE.suture, release=True), timeout_s=WORK_MS / 1000)
    return service.url


@pytest.fixture
def tab(browser: Browser, url: str) -> Iterator[Watched]:
    with visiting(browser, url) as opened:
        yield opened


@pytest.fixture
def flat(browser: Browser, url: str) -> Iterator[Watched]:
    """Yield a tab without 3-D views, for tests of what stands beside them."""
    with visiting(browser, url, view=False) as opened:
        yield opened


def camera(scene: Locator) -> list[float]:
    return [float(one) for one in (scene.get_attribute("data-eye") or "nan nan nan").split()]


def when_drawn(tab: Watched) -> Locator:
    scene = tab.page.locator("#view")
    expect(scene).to_have_attribute("data-drawn", "true")
    return scene


@pytest.mark.nightly  # 25 s of processor time, most of it for 3D views rendered in software; by day each page is opened
def test_from_an_empty_service_to_a_playback(browser: Browser, tmp_path: Path) -> None:
    with running(tmp_path) as fresh, visiting(browser, fresh.url) as tab:
        add_a_surgeon(tab)
        send_a_recording(tab, tmp_path)
        accept_a_hand_off(tab)
        train_and_release(tab)
        plan_and_play(tab)


def add_a_surgeon(tab: Watched) -> None:
    tab.open("/")
    expect(tab.page.get_by_role("heading", name="No style yet")).to_be_visible()
    tab.shoot("empty")
    tab.page.get_by_role("link", name="Add a surgeon").click()
    tab.page.get_by_label("Pseudonym, never a name").fill(SAMPLE.surgeon)
    tab.page.get_by_label("Skill").select_option("expert")
    tab.page.get_by_role("button", name="Save the surgeon").click()
    expect(tab.page.get_by_role("row", name=re.compile(f"{SAMPLE.surgeon} expert"))).to_be_visible()


def send_a_recording(tab: Watched, folder: Path) -> None:
    recording = folder / "theatre.mcap"
    recording.write_bytes(SAMPLE.data)
    tab.open(f"/pages/recordings/new?surgeon={SAMPLE.surgeon}&suture={SAMPLE.suture}")
    tab.page.get_by_label("Choose a file, or drop it here").set_input_files(recording)
    tab.page.get_by_role("button", name="Preview").click()
    expect(tab.page.locator("#seen")).to_contain_text("hand-offs are proposed")
    tab.page.get_by_role("button", name="Store it").click()
    tab.page.wait_for_url(re.compile("/pages/recordings/[0-9a-f]{64}"))


def accept_a_hand_off(tab: Watched) -> None:
    """Choose a proposal with the keyboard, and correct its start."""
    page = tab.page
    expect(page.locator("#timeline svg")).to_have_attribute("data-drawn", "true")
    page.get_by_role("button", name=re.compile("^Proposal 2,")).press("Enter")
    begins = page.locator('[name="start_s"]')
    corrected = round(float(begins.input_value()) + 0.05, 3)
    begins.fill(str(corrected))
    assert float(page.locator("#from").input_value()) == pytest.approx(corrected, abs=0.011)
    page.get_by_role("button", name="Accept this hand-off").click()
    expect(page.locator("#made")).to_contain_text("Path length")
    tab.shoot("hand-off")


def train_and_release(tab: Watched) -> None:
    made = tab.page.locator("#made")
    made.get_by_role("button", name="Train", exact=True).click()
    expect(made).to_contain_text("was learnt and passes the gate", timeout=WORK_MS)
    made.get_by_role("button", name="Release version 1").click()
    expect(made).to_contain_text("Version 1 is released")
    tab.open("/")
    expect(tab.page.get_by_role("link", name=re.compile("released.*version 1 served"))).to_be_visible()


def plan_and_play(tab: Watched) -> None:
    page = tab.page
    tab.open("/pages/plans/new")
    expect(page.locator("#above")).to_have_attribute("data-drawn", "true")
    page.get_by_label("Points", exact=True).fill("2")
    page.get_by_role("button", name="Lay").click()
    x = page.get_by_label("Pass 1, x in mm")
    at = float(x.input_value())
    page.get_by_role("slider", name="Suture point 1").press("ArrowRight")
    assert float(x.input_value()) == pytest.approx(at + 1)
    page.get_by_role("button", name="Where can I plan?").click()
    expect(page.locator("#reach-said")).to_contain_text("places can be planned")
    tab.shoot("reach")
    page.locator(".above .reach .yes").first.dispatch_event("click")
    expect(page.get_by_label("Pass 2, x in mm")).to_be_visible()
    page.get_by_role("button", name="Remove pass 2").click()
    page.get_by_role("button", name="Make the plan").click()

    page.wait_for_url(re.compile("/pages/plans/[0-9a-f]{64}"))
    assert colours(when_drawn(tab).screenshot()) > 100
    page.get_by_role("button", name="Play it in the simulator").click()
    verdict = page.locator(".verdict")
    expect(verdict).to_contain_text("feasible in an exact simulation", timeout=WORK_MS)
    expect(verdict).to_contain_text(re.compile(r"\d+ of 1[ ,]?000 worlds"))
    expect(verdict).to_contain_text("hands the needle to PSM_M")
    picture = page.get_by_role("img", name="The simulated scene with all passes")
    picture.scroll_into_view_if_needed()
    page.wait_for_function("img => img.complete && img.naturalWidth > 100", arg=picture.element_handle())
    expect(page.locator("#no-bag")).to_contain_text("states no tissue")
    expect(page.get_by_role("button", name="Replay bag")).to_have_count(0)
    with page.expect_download() as samples:
        page.get_by_role("button", name="Samples (JSON)").click()
    assert "rows" in json.loads(Path(samples.value.path()).read_bytes())
    film = page.get_by_label("Film of the playback")
    expect(film).to_be_visible(timeout=WORK_MS)  # it is drawn after the verdict, and appears by itself
    page.wait_for_function("film => film.readyState > 0 && film.duration > 1", arg=film.element_handle())
    when_drawn(tab)
    tab.shoot("plan")


class Clicks:
    """The clicks of a user on a page; filling a field counts one too."""

    def __init__(self) -> None:
        self.count = 0

    def click(self, at: Locator) -> None:
        self.count += 1
        at.click()

    def fill(self, at: Locator, text: str) -> None:
        self.count += 1
        at.fill(text)


def test_a_bag_comes_to_a_verdict_in_six_clicks(browser: Browser, tmp_path: Path) -> None:
    bag = tmp_path / "session.mcap"
    bag.write_bytes(SAMPLE.data)  # with five hand-offs, so that one is asked for
    with by_a_thread(tmp_path) as fresh, visiting(browser, fresh.url, view=False) as tab:
        tab.open("/")
        page, user, steps = tab.page, Clicks(), tab.page.locator("#try-steps")
        user.count += 1  # the drop
        page.get_by_label("Drop a recording here, or choose it").set_input_files(bag)
        user.click(page.get_by_role("button", name="Try it"))
        user.click(steps.get_by_role("button", name=re.compile("^Take proposal 2: ")))
        user.fill(steps.get_by_label("Height in mm"), "-170")
        user.click(steps.get_by_label("errors of a calibrated arm"))
        expect(steps).to_contain_text("It passes the gate of a release.")
        tab.shoot("try-questions")
        user.click(steps.get_by_role("button", name="Release it"))
        expect(steps).to_contain_text("feasible in an exact simulation", timeout=WORK_MS)
        assert user.count <= 6
        expect(steps).to_contain_text("Version 1 is served now.")
        tab.shoot("try")
        steps.get_by_role("link", name="See the plan").click()
        page.wait_for_url(re.compile("/pages/plans/[0-9a-f]{64}"))
        expect(page.locator(".verdict")).to_contain_text("feasible in an exact simulation")


@pytest.mark.nightly  # the choices themselves are tested by day in tests/library/test_tries.py
def test_a_refused_try_has_a_button_that_applies_the_remedy(browser: Browser, tmp_path: Path) -> None:
    with running(tmp_path) as fresh, visiting(browser, fresh.url, view=False) as tab:
        tab.open("/")
        page, steps = tab.page, tab.page.locator("#try-steps")
        page.get_by_label("Drop a recording here, or choose it").set_input_files(
            files=[{"name": "hand-off.csv", "mimeType": "text/csv", "buffer": cases.hand_off()}]
        )
        page.get_by_label("Surgeon's pseudonym, never a name").fill("lark")
        page.route(
            "**/tries", lambda asked: asked.continue_(post_data={**asked.request.post_data_json, "loss_mm": 0.01})
        )
        page.get_by_role("button", name="Try it").click()
        expect(steps.locator(".refused")).to_contain_text("the finest lose", timeout=WORK_MS)
        page.unroute("**/tries")
        steps.get_by_role("button", name=re.compile("^Accept a loss of ")).click()
        expect(steps).to_contain_text("It passes the gate of a release.", timeout=WORK_MS)


@pytest.mark.nightly  # 23 s: it is rendered in software
def test_the_view_can_be_turned_and_starts_chosen(tab: Watched) -> None:
    tab.open(f"/pages/styles/{STYLE}")
    page, scene = tab.page, when_drawn(tab)
    followed = page.locator("#starts li")
    expect(followed).to_have_count(1)  # the demonstrated start
    assert colours(scene.screenshot()) > 100
    page.get_by_role("button", name="Oblique").click()
    before, box = camera(scene), scene.bounding_box()
    assert box is not None
    middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    page.mouse.move(*middle)
    page.mouse.down()
    page.mouse.move(middle[0] + 120, middle[1] + 20, steps=6)
    page.mouse.up()
    dragged = camera(scene)
    assert np.abs(np.subtract(dragged, before)).max() > 0.1
    scene.focus()
    scene.press("ArrowRight")
    assert np.abs(np.subtract(camera(scene), dragged)).max() > 0.02

    start = page.locator("#start")
    start.get_by_label("x mm").fill("20")
    start.get_by_label("y mm").fill("75")
    start.get_by_role("button", name="Follow").click()
    expect(followed).to_have_count(2)
    expect(followed.last).to_contain_text("reaches the goal")
    pick_a_start(tab, middle)
    expect(followed).to_have_count(3)
    page.get_by_role("checkbox", name="Rewards").check()
    with page.expect_download() as saved:
        page.get_by_role("button", name="Save picture").click()
    assert colours(Path(saved.value.path()).read_bytes()) > 100
    tab.shoot("style")


def pick_a_start(tab: Watched, middle: tuple[float, float]) -> None:
    """Point at places of the view until the hint names a start, and click there."""
    hint = tab.page.locator("#view .hint")
    for across in range(0, 200, 7):
        tab.page.mouse.move(middle[0] + across, middle[1] + across / 3)
        if hint.is_visible() and "reaches the goal" in hint.inner_text():
            break
    assert "of the demonstration" in hint.inner_text()
    tab.page.mouse.down()
    tab.page.mouse.up()


def test_what_is_refused_is_said_in_words_where_it_arose(browser: Browser, url: str) -> None:
    tab = Watched(browser, url, view=False)
    tab.open(f"/pages/styles/{STYLE}")
    when_drawn(tab)
    start = tab.page.locator("#start")
    start.get_by_label("x mm").fill("9000")
    start.get_by_role("button", name="Follow").click()
    expect(tab.page.locator("#start-said")).to_contain_text("outside the grid")
    tab.context.close()
    assert [one for one in tab.complaints if "422" not in one] == []  # Chromium itself logs the refusal


def test_a_withdrawal_says_what_it_means_and_needs_a_yes(flat: Watched, client: Client) -> None:
    page, dialog = flat.page, flat.page.get_by_role("dialog")
    flat.open(f"/pages/styles/{STYLE}")
    page.get_by_role("button", name="Withdraw the release").click()
    expect(dialog).to_contain_text("No policy of this style is served")
    dialog.get_by_role("button", name="Cancel").click()
    expect(dialog).to_be_hidden()
    assert client.policy(SAMPLE.surgeon, SAMPLE.suture)
    page.get_by_role("button", name="Withdraw the release").click()
    dialog.get_by_role("button", name="Withdraw").click()
    expect(page.locator(".lead").first).to_contain_text("learnt, not released")
    page.get_by_role("button", name="Release", exact=True).click()
    dialog.get_by_role("button", name="Release").click()
    expect(page.locator(".lead").first).to_contain_text("version 1 is served to clients")


@pytest.mark.nightly  # by day the calls behind the page are tested
def test_an_outcome_is_marked_on_the_page_of_its_style(flat: Watched, client: Client) -> None:
    page, dialog = flat.page, flat.page.get_by_role("dialog")
    flat.open(f"/pages/styles/{STYLE}")
    page.get_by_text("Mark the outcome of a demonstration").click()
    page.get_by_label("Outcome").select_option("recovery")
    page.get_by_label("Why, for a recovery or a failure").fill("The needle slipped.")
    page.get_by_role("button", name="Mark", exact=True).click()
    expect(dialog).to_contain_text("releases that rest on it are withdrawn")
    dialog.get_by_role("button", name="Mark").click()
    expect(page.locator(".badge", has_text="recovery")).to_have_attribute("title", "The needle slipped.")
    expect(page.locator(".lead").first).to_contain_text("learnt, not released")
    (demo,) = client.demos(outcome="recovery")
    client.mark_demo(demo.id, "success")
    client.release(SAMPLE.surgeon, SAMPLE.suture, 1)


def test_points_on_a_line_are_at_least_one_and_at_most_50(flat: Watched) -> None:
    """Before, a negative number removed every point, and a large one stopped the page."""
    flat.open("/pages/plans/new")
    points = flat.page.locator("#points tr")
    expect(points).to_have_count(5)
    for wrong in ("-3", "5000"):
        flat.page.locator("#line-count").fill(wrong)
        flat.page.get_by_role("button", name="Lay").click()
        assert points.count() == 5
    flat.page.locator("#line-count").fill("3")
    flat.page.get_by_role("button", name="Lay").click()
    expect(points).to_have_count(3)


def test_an_erasure_waits_until_the_pseudonym_is_typed(tab: Watched, client: Client) -> None:
    page, dialog = tab.page, tab.page.get_by_role("dialog")
    client.put_surgeon("siskin")
    tab.open("/pages/catalogue")
    page.get_by_role("button", name="Erase siskin").click()
    erase = dialog.get_by_role("button", name="Erase permanently")
    expect(erase).to_be_disabled()
    dialog.get_by_label("Type siskin to go on").fill("siski")
    expect(erase).to_be_disabled()
    dialog.get_by_label("Type siskin to go on").fill("siskin")
    erase.click()
    expect(page.get_by_role("button", name="Erase siskin")).to_have_count(0)
    expect(page.get_by_role("button", name=f"Erase {SAMPLE.surgeon}")).to_be_visible()


@pytest.mark.nightly  # by day the calls behind the page are tested
def test_a_batch_is_started_and_watched(tab: Watched) -> None:
    page = tab.page
    tab.open("/pages/jobs")
    page.get_by_label("only styles with newer input").uncheck()
    page.get_by_role("button", name="Train again").click()
    page.wait_for_url(re.compile("/pages/jobs/[0-9a-f]{16}"))
    ended = page.locator("#job:not([data-renew])")  # the page reloads once at the end
    expect(ended).to_contain_text("1 of 1 styles done", timeout=WORK_MS)
    tab.shoot("batch")


BY_DAY = "phone-dark"  # without 3-D views, which take most of the time
BY_NIGHT = [pytest.param(name, marks=pytest.mark.nightly) for name in ("desk-light", "desk-dark", "phone-light")]
PAGES = {
    "style": f"/pages/styles/{STYLE}",
    "styles": "/",
    "recordings": "/pages/recordings",
    "upload": "/pages/recordings/new",
    "plans": "/pages/plans",
    "plan-editor": "/pages/plans/new",
    "jobs": "/pages/jobs",
    "catalogue": "/pages/catalogue",
    "atlas": f"/pages/atlas/{SAMPLE.suture}",
}
DRAWN = {"recording": "#timeline svg", "plan": "#view"}


@pytest.fixture(scope="module")
def pages(url: str, client: Client) -> dict[str, str]:
    """Return the paths of all pages; those of the recording and of a plan have digests in them."""
    (demo,) = client.demos(surgeon=SAMPLE.surgeon)
    plan = client.plan(SAMPLE.surgeon, SAMPLE.suture, [GOAL_MM], handoff="none")
    return PAGES | {"recording": f"/pages/recordings/{demo.recording}", "plan": f"/pages/plans/{plan.sha256}"}


@pytest.mark.parametrize("name", [BY_DAY, *BY_NIGHT])
def test_every_page_fits_its_window_and_says_what_it_is_for(
    browser: Browser, url: str, pages: dict[str, str], name: str
) -> None:
    how = {"phone": "phone" in name, "dark": "dark" in name}
    with visiting(browser, url, **how, view=name != BY_DAY) as tab:
        for which, path in pages.items():
            tab.open(path)
            if which in DRAWN:
                expect(tab.page.locator(DRAWN[which])).to_have_attribute("data-drawn", "true")
            assert tab.too_wide() <= 0, which
            expect(tab.page.get_by_text("not a medical device").first).to_be_visible()
            tab.shoot(f"{name}-{which}")


BORROWED = {"/docs": "#calls"}  # drawn by Swagger UI, in which axe finds contrast, landmarks and links within buttons
# What a page that loads its content has when it is complete.
LOADING = {
    "/docs": ".opblock-tag >> nth=0",
    "/pages/player/{source}/{digest}": "#player[data-ready]",
    "/pages/proposals": "body[data-drawn]",
    "/pages/recordings/{recording}": "#timeline svg[data-drawn]",
    "/pages/styles/{surgeon}/{suture}": "#view[data-drawn]",
}


def test_axe_finds_nothing_on_any_page_of_any_route(browser: Browser, service: Service, pages: dict[str, str]) -> None:
    """A page is whatever a route answers to a browser with HTML, so a new one is examined without being listed here."""
    with Client(service.url) as client, visiting(browser, service.url, view=False) as tab:
        (demo,), (job, *_) = client.demos(surgeon=SAMPLE.surgeon), client.jobs()
        known = {"surgeon": SAMPLE.surgeon, "suture": SAMPLE.suture, "version": "1", "demo": demo.id, "job": job.id}
        known |= {"recording": demo.recording, "plan": pages["plan"].rpartition("/")[2], "source": "demos"}
        known |= {"digest": demo.id, "policy": client.versions(SAMPLE.surgeon, SAMPLE.suture)[0].sha256}
        examined, found = set(), {}
        for path in sorted({one.path for one in create_app(Settings()).routes if "GET" in getattr(one, "methods", ())}):
            names = set(re.findall("{(\\w+)}", path))
            if path.startswith("/pages/"):
                assert names <= set(known), f"{path}: name an example of its parameters here"
            if not names <= set(known):
                continue
            where = path.format(**known)
            # Its head alone: the events of a job that waits have no end.
            with client.http.stream("GET", where, headers={"Accept": "text/html"}) as answer:
                if not answer.headers.get("content-type", "").startswith("text/html"):
                    continue
                assert answer.status_code == 200, (path, answer.status_code)
            tab.open(where)
            if path in LOADING:
                expect(tab.page.locator(LOADING[path])).to_have_count(1)
            examined.add(path)
            found[path] = axe(tab.page, BORROWED.get(path))
        assert [(path, one) for path, broken in found.items() for one in broken] == []
        assert examined >= {"/", "/docs", "/sign-in", "/demos/{demo}/report", "/policy-versions/{policy}/card"}
        assert len(examined) >= 20


@pytest.mark.nightly  # by day each page is opened
def test_light_or_dark_is_chosen_and_stays(tab: Watched) -> None:
    ground = "getComputedStyle(document.body).backgroundColor"
    tab.open("/pages/jobs")
    light = tab.page.evaluate(ground)
    tab.page.get_by_role("button", name="Light or dark").dblclick()  # from the system's scheme over light to dark
    dark = tab.page.evaluate(ground)
    assert dark != light
    tab.open("/pages/plans")
    assert tab.page.evaluate(ground) == dark


NAME = "one => (one.ariaLabel || one.labels?.[0]?.textContent || one.textContent || one.placeholder || '').trim()"


def test_everything_is_reached_with_the_keyboard_and_the_focus_is_seen(tab: Watched) -> None:
    page = tab.page
    tab.open("/")
    shown = page.locator("a[href], button, input:not([type=hidden]), select, textarea, summary, [tabindex='0']").filter(
        visible=True
    )
    names = shown.evaluate_all(f"every => every.map({NAME})")
    for name in names:
        page.keyboard.press("Tab")
        assert page.evaluate(f"({NAME})(document.activeElement)") == name != ""
        assert page.evaluate("getComputedStyle(document.activeElement).outlineStyle") != "none", name
    assert names[0] == "Skip to the content"
    assert {"Styles", "Recordings", "Plans", "Jobs", "Catalogue", "Try it"} <= set(names)
    assert any(name.startswith("● released") for name in names)  # the style's card


@pytest.mark.nightly  # by day tests/api reads the page
@pytest.mark.parametrize("name", ["desk-light", "phone-dark"])
def test_a_demonstration_is_scored_from_the_page_of_its_style(browser: Browser, url: str, name: str) -> None:
    with visiting(browser, url, phone="phone" in name, dark="dark" in name, view=False) as tab:
        tab.open(f"/pages/styles/{STYLE}")
        tab.page.get_by_role("link", name="Score").first.click()
        tab.page.wait_for_url(re.compile("/pages/demos/[0-9a-f]{64}/score"))
        expect(tab.page.get_by_role("heading", name="Where it deviates")).to_be_visible()
        expect(tab.page.get_by_text("This demonstration is the reference itself")).to_be_visible()
        way = tab.page.locator("#where polyline.apart-0").first
        assert way.evaluate("way => getComputedStyle(way).strokeWidth") == "2px"
        expect(tab.page.locator("#rating")).to_contain_text("Not calibrated")
        expect(tab.page.get_by_text("not a credential")).to_be_visible()
        assert tab.too_wide() <= 0
        tab.shoot(f"score-{name}")


@pytest.mark.parametrize("phone", [False, pytest.param(True, marks=pytest.mark.nightly)])
def test_a_table_is_previewed_with_what_is_said_of_it_and_then_stored(
    browser: Browser, url: str, client: Client, tmp_path: Path, phone: bool
) -> None:
    table = tmp_path / "hand-off.csv"
    table.write_text(written.positions("wren" if phone else "heron"))
    surgeon = "pipit" if phone else "dunlin"
    client.put_surgeon(surgeon)
    with visiting(browser, url, phone=phone) as tab:
        page, asked = tab.page, tab.asked
        tab.open("/pages/recordings/new")
        page.get_by_label("Choose a file, or drop it here").set_input_files(table)
        page.get_by_role("button", name="Preview").press("Enter")
        expect(page.locator("#upload-said")).to_contain_text("unknown column 'PosX'")
        tab.complaints.clear()  # the refusal is a response of 422, which the console shows
        page.get_by_label("Columns under other names").fill("x=PosX\ny=PosY\nz=PosZ\n")
        page.get_by_label("Lengths").select_option("mm")
        page.get_by_label("Frame of the positions").fill("base")
        page.get_by_label("Arm", exact=True).fill("PSM2")
        page.get_by_label("Surgeon who was recorded").select_option(surgeon)
        page.get_by_role("button", name="Preview").click()
        seen = page.get_by_role("region", name="What was understood")
        expect(seen).to_be_focused()
        expect(seen).to_contain_text("it is stored only with a rate")
        expect(seen.get_by_role("button", name="Store it")).to_be_disabled()
        seen.get_by_role("button", name="Change something").click()
        expect(page.get_by_label("Frame of the positions")).to_be_focused()
        page.get_by_label("Rate").fill("100")
        expect(seen).to_be_hidden()  # the preview was of other answers
        page.get_by_role("button", name="Preview").click()
        expect(seen.locator("tr", has_text="PosX")).to_have_text("PosXxmm")
        expect(seen).to_contain_text("1 hand-off is proposed")
        assert tab.too_wide() <= 0
        tab.shoot(f"upload-table-{'phone' if phone else 'desk'}")
        assert not [one for one in asked if "/recordings?" in one], "nothing is stored before the button is pressed"
        seen.get_by_role("button", name="Store it").click()
        page.wait_for_url(re.compile(f"/pages/recordings/[0-9a-f]{{64}}.surgeon={surgeon}"))
        assert any(one.endswith(f"surgeon={surgeon}") for one in asked if "/recordings?" in one)
        expect(page.get_by_role("heading", name="Quality")).to_be_visible()
        accept_as_a_failure(tab, surgeon)
    (demo,) = client.demos(surgeon=surgeon)
    assert (demo.arm, demo.outcome, demo.outcome_reason) == ("PSM2", "failure", "The needle fell.")


def accept_as_a_failure(tab: Watched, surgeon: str) -> None:
    """Accept the proposed hand-off as a failure, which needs a reason, and ask to learn from it."""
    page = tab.page
    accept = page.get_by_role("button", name="Accept this hand-off")
    form = page.locator("#accept")
    expect(page.locator("#timeline svg")).to_have_attribute("data-drawn", "true")
    expect(form.get_by_label("Surgeon")).to_have_value(surgeon)
    form.get_by_label("Suture type").select_option(SAMPLE.suture)
    expect(form.get_by_label("Why, for a recovery or a failure")).to_be_hidden()
    form.get_by_label("Outcome").select_option("failure")
    accept.click()  # refused by the browser: the reason is needed
    expect(page.locator("#made")).to_be_hidden()
    form.get_by_label("Why, for a recovery or a failure").fill("The needle fell.")
    tab.shoot("outcome")
    assert tab.too_wide() <= 0
    accept.click()
    expect(page.locator("#made").get_by_role("row", name=re.compile("^Outcome failure"))).to_contain_text(
        "The needle fell."
    )
    page.locator("#made").get_by_role("button", name="Train", exact=True).click()
    dialog = page.get_by_role("dialog")
    expect(dialog).to_contain_text("marked failure")
    dialog.get_by_role("button", name="Cancel").click()
    page.reload()
    expect(page.locator(".badge", has_text="failure")).to_be_visible()
    expect(page.get_by_text("Mark the outcome of a demonstration")).to_be_visible()


def sent_from(tab: Watched) -> bytes:
    """Return the bytes of the folder "theatre" that the page will send."""
    expect(tab.page.locator("#chosen")).to_contain_text("theatre.zip")
    sent = tab.page.evaluate("document.getElementById('file').files[0].arrayBuffer().then(b => [...new Uint8Array(b)])")
    return bytes(sent)


def drop(tab: Watched, onto: str, file: Path) -> None:
    """Drag a file or a folder of the disk onto an element and drop it, as a file manager does."""
    box = tab.page.locator(onto).bounding_box()
    assert box is not None
    browser = tab.context.new_cdp_session(tab.page)
    held = {"items": [], "files": [str(file)], "dragOperationsMask": 1}
    for step in ("dragEnter", "dragOver", "drop"):
        place = {"x": box["x"] + box["width"] / 2, "y": box["y"] + 5}
        browser.send("Input.dispatchDragEvent", {"type": step, "data": held, **place})


def test_the_folder_of_a_bag_is_sent_as_one_file_without_its_pictures(flat: Watched, tmp_path: Path) -> None:
    bag = tmp_path / "theatre"
    (bag / "camera").mkdir(parents=True)
    (bag / "part_0.mcap").write_bytes(cases.bag("PSM1"))
    (bag / "camera" / "0.png").write_bytes(b"not sent")
    flat.open("/pages/recordings/new")
    flat.page.get_by_label("or a bag's folder").set_input_files(bag)
    chosen = sent_from(flat)
    with ZipFile(io.BytesIO(chosen)) as packed:
        assert packed.testzip() is None
        assert packed.namelist() == ["theatre/part_0.mcap"]
    flat.open("/pages/recordings/new")
    drop(flat, "#drop", bag)
    assert sent_from(flat) == chosen
    flat.page.get_by_role("button", name="Preview").click()
    expect(flat.page.locator("#seen")).to_contain_text("PSM1")
    expect(flat.page.get_by_role("button", name="Store it")).to_be_enabled()


@pytest.mark.nightly  # by day, of a table
def test_joints_beside_poses_are_identified_in_the_preview(browser: Browser, url: str, tmp_path: Path) -> None:
    recording = tmp_path / "session.csv"
    recording.write_text(written.ee_csv(more=True))
    with visiting(browser, url) as tab:
        tab.open("/pages/recordings/new")
        tab.page.get_by_label("Choose a file, or drop it here").set_input_files(recording)
        tab.page.get_by_text("What the file does not say").click()
        tab.page.get_by_label("Frame of the positions").fill("base")
        tab.page.get_by_role("button", name="Preview").click()
        seen = tab.page.get_by_role("region", name="What was understood")
        expect(seen.get_by_role("row", name="PSM2 /PSM2/measured_cp identified Classic, 400006")).to_be_visible()
        tab.shoot("upload-identified")
