"""The page as a person meets it: in a real browser, against a real server that gets killed."""

import os
import re
from pathlib import Path

import numpy as np
import pytest
from live_server import LiveServer

from misstep import load_dataset, load_run
from misstep.mixture import (
    Conditioner,
    DonutMixture,
    GaussianMixture,
    exploration_from_variance,
)

CHROMIUM = os.environ.get("CHROMIUM", "/usr/bin/chromium")
SCREENS = Path(__file__).resolve().parents[1] / "out" / "live-screens"
SIZES = {"1280x720": (1280, 720), "1920x1080": (1920, 1080), "3840x2160": (3840, 2160)}
PHONE = (390, 844)
PATIENCE = 90_000.0  # ms; on a busy machine a process that learns takes long to start

sync_api = pytest.importorskip(
    "playwright.sync_api", reason="the page is tried in a browser: pip install playwright"
)
expect = sync_api.expect
expect.set_options(timeout=PATIENCE)
pytestmark = pytest.mark.skipif(
    not Path(CHROMIUM).exists(),
    reason="the page is tried in Chromium: apt-get install chromium, or set CHROMIUM to its path",
)


@pytest.fixture(scope="module")
def browser():
    with sync_api.sync_playwright() as playwright:
        # No sandbox: it needs a user other than root.
        chromium = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield chromium
        chromium.close()


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    server = LiveServer(tmp_path_factory.mktemp("page") / "data")
    yield server
    server.close()


@pytest.fixture
def page(browser, server):
    page = open_page(browser, server)
    yield page
    assert page.faults == []
    page.context.close()


def open_page(browser, server, size=(1280, 720), **options):
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, accept_downloads=True, **options
    )
    context.set_default_timeout(PATIENCE)
    page = context.new_page()
    page.faults = []
    page.on("pageerror", lambda error: page.faults.append(str(error)))
    page.on("request", lambda request: _stays_here(page, server, request.url))
    page.goto(server.url)
    page.wait_for_selector("#attempts li")
    expect(page.locator("#link-state")).to_contain_text("● connected")
    return page


def _stays_here(page, server, address):
    if not address.startswith((server.url, server.url.replace("http", "ws"), "data:", "blob:")):
        page.faults.append(f"asked for {address}")


def begin(page):
    """Start an attempt, and go on should a busy machine have paused it for the page's silence."""
    page.keyboard.press("Space")
    page.wait_for_selector("#fail, #resume")
    while page.locator("#resume").count():
        page.keyboard.press("Space")
        page.wait_for_selector("#fail, #resume")


def fail_by_hand(page, number):
    """Start, hold keys until the pole has fallen, and keep the attempt."""
    begin(page)
    keys = ["ArrowLeft", "ArrowRight"]
    for turn in range(200):
        key = keys[(turn + number) % 2]
        page.keyboard.down(key)
        page.wait_for_timeout(260 + 90 * ((turn * 7 + number * 3) % 4))
        page.keyboard.up(key)
        if page.locator("#keep").count():
            break
        if page.locator("#resume").count():
            page.keyboard.press("Space")
    assert "fell to the" in page.locator("#callout").inner_text()
    page.keyboard.press("Enter")
    page.wait_for_selector("#begin")


def learn(page, learner):
    """Learn at full speed, and return what is said of the last trial."""
    page.select_option("#learner", learner)
    page.locator("#more summary").click()
    page.fill("#max-trials", "60")
    page.locator("#more summary").click()
    page.click("#learn")
    page.wait_for_selector("#player", state="visible")
    page.select_option("#playback", "full")
    page.wait_for_selector("#learn", state="visible")
    expect(page.locator("#sentence")).to_contain_text("succeeded")
    return page.locator("#sentence").inner_text()


def balance(page, seconds):
    """Let it balance for a while, push it, and return the largest angle at the end, deg."""
    page.click("#balance")
    page.wait_for_selector("#poke-left")
    page.keyboard.press("ArrowRight")
    page.wait_for_timeout(1000 * seconds)
    angles = page.evaluate(
        """async () => {
            const seen = [];
            for (let i = 0; i < 10; i++) {
                await new Promise(requestAnimationFrame);
                seen.push(parseFloat(document.querySelectorAll('#hud b')[1].textContent
                    .replace('−', '-')));
            }
            return seen;
        }"""
    )
    page.keyboard.press("Escape")
    page.wait_for_selector("#begin")
    return max(map(abs, angles))


def test_a_person_fails_four_times_learns_twice_and_it_balances(browser, server, tmp_path):
    page = open_page(browser, server)
    page.locator("#countdown").evaluate("e => { e.value = 0; e.dispatchEvent(new Event('input')) }")
    for number in range(4):
        fail_by_hand(page, number)
    file = server.folder / "cartpole" / "attempts.h5"
    kept = load_dataset(file)
    assert len(kept) == 4
    assert {t.provenance.demonstrator for t in kept} == {"person"}
    assert all(t.failure_step == t.n_steps for t in kept)
    assert all(np.ptp(t.actions) > 0 for t in kept)

    # Rung 2, and it balances, also when it is pushed.
    assert "succeeded" in learn(page, "fall")
    assert balance(page, 2.0) < 12.0

    # The server dies and comes back; the page says so, and goes on by itself.
    server.kill()
    page.wait_for_selector("#notice:has-text('connection to the server is lost')")
    server.start()
    page.wait_for_selector("#notice", state="hidden")
    assert page.locator("#attempts li").count() == 4

    # Rung 4.
    assert "Trial" in learn(page, "dynamics")
    assert balance(page, 2.0) < 12.0

    # The attempts as a file, and the session as one page that needs no server.
    page.locator("#save-menu summary").click()
    page.select_option("#format", "csv")
    with page.expect_download() as download:
        page.click("#save-attempts")
    download.value.save_as(tmp_path / "mine.csv")
    back = load_dataset(tmp_path / "mine.csv")
    assert [t.n_steps for t in back] == [t.n_steps for t in kept]
    page.locator("#save-menu summary").click()
    with page.expect_download() as download:
        page.click("#save-replay")
    download.value.save_as(tmp_path / "replay.html")

    # The saved run is opened again, and is one for every command.
    page.reload()
    page.locator("#more summary").click()
    page.locator("#more-sheet .row", has_text="001-fall").get_by_text("Open").click()
    page.wait_for_selector("#balance:not([disabled])")
    assert load_run(server.folder / "cartpole" / "runs" / "001-fall").succeeded
    assert page.faults == []
    page.context.close()

    replay = browser.new_context(offline=True).new_page()
    faults = []
    replay.on("pageerror", lambda error: faults.append(str(error)))
    replay.goto((tmp_path / "replay.html").as_uri())
    replay.wait_for_selector("#player", state="visible")
    assert "succeeded" in replay.locator("#sentence").inner_text()
    before = replay.locator("#clock").inner_text()
    replay.click("#step-on")
    expect(replay.locator("#clock")).not_to_have_text(before)
    assert faults == []
    SCREENS.mkdir(parents=True, exist_ok=True)
    replay.screenshot(path=SCREENS / "replay.png")
    replay.context.close()


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_it_fits_every_screen_and_nothing_is_cut_off(browser, server, theme):
    SCREENS.mkdir(parents=True, exist_ok=True)
    for name, size in SIZES.items():
        page = open_page(browser, server, size, color_scheme=theme)
        page.wait_for_timeout(400)
        overflow = page.evaluate(
            "[document.documentElement.scrollWidth - innerWidth,"
            " document.documentElement.scrollHeight - innerHeight]"
        )
        page.screenshot(path=SCREENS / f"{name}-{theme}.png")
        assert max(overflow) <= 0, name
        assert _smallest_canvas(page) >= 60, name
        page.context.close()
    page = open_page(browser, server, PHONE, color_scheme=theme, has_touch=True, is_mobile=True)
    page.wait_for_timeout(400)
    page.screenshot(path=SCREENS / f"phone-{theme}.png", full_page=True)
    assert page.evaluate("document.documentElement.scrollWidth - innerWidth") <= 0
    assert page.locator("#pad-left").is_visible()
    page.context.close()


def _smallest_canvas(page):
    return page.evaluate(
        "Math.min(...[...document.querySelectorAll('canvas')].map(c => c.clientHeight))"
    )


def test_the_density_on_the_page_is_the_one_that_python_computes(page):
    rng = np.random.default_rng(3)
    X = rng.normal(size=(300, 3)) @ rng.normal(size=(3, 3)) + np.where(
        rng.random((300, 1)) < 0.5, 3.0, -3.0
    )
    mixture = GaussianMixture(n_components=2, random_state=0).fit(X)
    c = Conditioner(mixture, range(2))
    told = {
        "state": ["a", "b"],
        "weights": mixture.weights_.tolist(),
        "means": mixture.means_.tolist(),
        "covariances": mixture.covariances_.tolist(),
        "state_constants": c.state_constants.tolist(),
        "state_means": c.state_means.tolist(),
        "state_whiteners": c.state_whiteners.tolist(),
        "gains": c.gains.tolist(),
        "action_means": c.action_means.tolist(),
        "action_covariances": c.covariances.tolist(),
        "scale": [0.7],
        "k": 2.0,
        "reach": 3.0,
    }
    state, grid = [0.4, -1.2], np.linspace(-6, 6, 13)
    shown = page.evaluate(
        """async ([told, state, grid]) => {
            const { Model } = await import("misstep/model.js");
            const model = new Model(told, [{name: "a"}, {name: "b"}]), c = model.at(state);
            return {epsilon: c.epsilon, mean: c.mean, plain: grid.map(a => model.gaussian(c, a)),
                    donut: grid.map(a => model.donut(c, a))};
        }""",
        [told, state, grid.tolist()],
    )
    conditional = c.at(state)
    epsilon = exploration_from_variance(conditional.variance, [0.7])
    assert shown["epsilon"] == pytest.approx(epsilon)
    assert shown["mean"] == pytest.approx(conditional.mean[0])
    plain = DonutMixture(conditional, 0.0).pdf(grid[:, None])
    assert shown["plain"] == pytest.approx(plain, abs=1e-12)
    donut = DonutMixture(conditional, epsilon, 2.0, 3.0).pdf(grid[:, None])
    assert shown["donut"] == pytest.approx(donut, abs=1e-12)


def test_a_reload_in_mid_attempt_pauses_it_and_a_second_tab_watches(browser, server):
    page = open_page(browser, server)
    page.locator("#speed").evaluate("e => { e.value = 1; e.dispatchEvent(new Event('input')) }")
    begin(page)
    expect(page.locator("#hud b").first).to_have_text(re.compile(r"0\.(0[4-9]|[1-9]).* s"))
    page.reload()
    page.wait_for_selector("#resume")
    assert "the attempt waits" in page.locator("#notice").inner_text()
    second = open_page(browser, server)
    assert "Another tab drives" in second.locator("#notice").inner_text()
    assert second.locator("#actions button").count() == 0
    second.click("#take")
    second.wait_for_selector("#resume")
    page.wait_for_selector("#take")
    second.keyboard.press("Space")
    second.wait_for_selector("#fail")
    second.keyboard.press("f")
    second.wait_for_selector("#keep")
    before = second.locator("#attempts li .n").count()
    second.keyboard.press("Backspace")
    second.wait_for_selector("#begin")
    second.click("#undo")
    expect(second.locator("#attempts li .n")).to_have_count(before + 1)
    assert page.faults == second.faults == []
    page.context.close()
    second.context.close()


def test_a_broken_file_and_a_foreign_message_are_told_in_one_sentence(page, tmp_path):
    if page.locator("#take").count():
        page.click("#take")
    (tmp_path / "broken.h5").write_bytes(b"no recording")
    page.set_input_files("#file", tmp_path / "broken.h5")
    page.wait_for_selector("#notice:has-text('broken.h5 was not added')")
    page.set_input_files("#file", {"name": "x.exe", "mimeType": "", "buffer": b"MZ"})
    page.wait_for_selector("#notice:has-text('is not known here')")
    text = page.locator("#notice").inner_text()
    assert "\n" not in text.strip()


def test_an_attempt_is_marked_and_cut_while_it_is_replayed(page, server):
    if page.locator("#take").count():
        page.click("#take")
    page.locator("#attempts li").first.get_by_label("Replay and mark").click()
    page.wait_for_selector("#marks", state="visible")
    before = page.locator("#marks").text_content()
    page.keyboard.press("Space")
    page.locator("#seek").evaluate("e => { e.value = 500; e.dispatchEvent(new Event('input')) }")
    page.click("#mark-failed")
    expect(page.locator("#marks")).not_to_have_text(before)
    first = load_dataset(server.folder / "cartpole" / "attempts.h5")[0]
    assert first.failure_time == pytest.approx(0.5 * first.duration, abs=1.1 * first.dt)
    page.click("#undo")
