"""The operator's page in a real browser."""

import shutil

import pytest
from fake_rig import DEMO_RECORDING
from live_service import serving, skeleton, wait_until
from playwright.sync_api import expect, sync_playwright

from canopy_skel.document import MovedView
from service.http.access import Access

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
FLAGS = ["--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-background-networking"]
INK = """canvas => {
    const {data} = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height);
    return data.reduce((count, value, i) => count + (i % 4 === 3 && value > 0), 0);
}"""

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="needs Debian's package chromium")


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=FLAGS)
        yield browser
        browser.close()


@pytest.fixture
def page(browser):
    page = browser.new_page()
    problems = []
    page.on("pageerror", lambda error: problems.append(str(error)))
    yield page
    page.close()
    assert problems == []


def started(page, live):
    """Start a scan as an operator does; return its id."""
    page.goto(live.url)
    expect(page.get_by_role("status")).to_have_text("ready")
    page.get_by_label("Tree").fill("row3-tree12")
    page.get_by_role("button", name="Start").click()
    expect(page.locator("#detail")).to_contain_text("running, 0 of 3 views")
    return live.rig.specs[0].scan_id


def test_an_operator_starts_a_scan_watches_the_skeleton_grow_and_stops_the_arm(page, tmp_path):
    with serving(tmp_path) as live:
        scan_id = started(page, live)
        live.rig.photograph(scan_id, 1)  # the recording behind it begins with view 1
        expect(page.get_by_alt_text("newest view")).to_be_visible()
        assert page.locator("#tree").evaluate(INK) == 0
        live.rig.publish(scan_id, skeleton(scan_id, 1))
        expect(page.locator("#legend")).to_contain_text("1.0 m in 1 branches")
        assert page.locator("#tree").evaluate(INK) > 100
        live.rig.publish(scan_id, skeleton(scan_id, 2, length_m=2.0))
        expect(page.locator("#legend")).to_contain_text("Skeleton of 2 views: 2.0 m")
        page.get_by_role("button", name="STOP").click()
        wait_until(lambda: live.rig.stops == 1)


def test_views_that_were_not_where_they_said_are_named_under_the_skeleton(page, tmp_path):
    with serving(tmp_path) as live:
        scan_id = started(page, live)
        moved = [MovedView(index=1, by_m=0.047)]
        live.rig.publish(scan_id, skeleton(scan_id, 1, moved=moved, alone=[2]))
        doubts = page.get_by_role("list", name="doubts").get_by_role("listitem")
        expect(doubts).to_have_count(2)
        expect(doubts.nth(0)).to_contain_text("View 1: its pose was 5 cm off")
        expect(doubts.nth(1)).to_contain_text("View 2 hardly agrees with any other")
        live.rig.publish(scan_id, skeleton(scan_id, 2))
        expect(doubts).to_have_count(0)


def test_a_recording_is_replayed_which_cannot_be_paused(page, tmp_path):
    with serving(tmp_path) as live:
        page.goto(live.url)
        page.get_by_label("Recording").set_input_files(DEMO_RECORDING)
        expect(page.locator("#detail")).to_contain_text("running, 0 of 4 views")
        [spec] = live.rig.fed
        assert live.rig.adopted == {spec.scan_id: DEMO_RECORDING.read_bytes()}
        expect(page.get_by_role("button", name="Pause")).to_be_disabled()
        page.get_by_role("button", name="Cancel").click()
        expect(page.locator("#detail")).to_contain_text("cancelled")
        expect(page.locator("#scans")).to_contain_text("replay · tree_apple_21 · cancelled")


def test_a_stop_is_shown_and_acknowledged_with_a_reason(page, tmp_path):
    page.on("dialog", lambda dialog: dialog.accept("way is clear"))
    with serving(tmp_path) as live:
        live.rig.broken_parts["arm"] = "protective stop; mend it, then acknowledge"
        page.goto(live.url)
        expect(page.get_by_role("status")).to_contain_text("arm: protective stop; mend it")
        page.get_by_role("button", name="Acknowledge").click()
        wait_until(lambda: live.rig.acknowledged == ["way is clear"])


def test_a_refused_start_says_why(page, tmp_path):
    with serving(tmp_path) as live:
        live.start()
        page.goto(live.url)
        page.get_by_label("Tree").fill("another")
        page.get_by_role("button", name="Start").click()
        expect(page.get_by_role("alert")).to_contain_text("is under way; wait or cancel it")


def test_the_page_asks_for_the_key_of_the_rig_once(page, tmp_path):
    asked = []

    def give(dialog):
        asked.append(dialog.message)
        dialog.accept(" 0123456789abcdef " if "key" in dialog.message else "way is clear")

    page.on("dialog", give)
    with serving(tmp_path, access=Access(key="0123456789abcdef")) as live:
        page.goto(live.url)
        page.get_by_label("Tree").fill("row3-tree12")
        page.get_by_role("button", name="Start").click()
        expect(page.locator("#detail")).to_contain_text("running, 0 of 3 views")
        page.get_by_role("button", name="Acknowledge").click()
        wait_until(lambda: live.rig.acknowledged == ["way is clear"])
    assert [message for message in asked if "key" in message] == ["This rig wants its key:"]


def test_a_wrong_key_is_said_to_be_one_and_asked_for_again(page, tmp_path):
    given = iter(["wrong", "0123456789abcdef"])
    page.on("dialog", lambda dialog: dialog.accept(next(given)))
    with serving(tmp_path, access=Access(key="0123456789abcdef")) as live:
        page.goto(live.url)
        page.get_by_label("Tree").fill("row3-tree12")
        page.get_by_role("button", name="Start").click()
        expect(page.get_by_role("alert")).to_contain_text("this is another one")
        page.get_by_role("button", name="Start").click()
        expect(page.locator("#detail")).to_contain_text("running, 0 of 3 views")
        assert len(live.rig.specs) == 1
