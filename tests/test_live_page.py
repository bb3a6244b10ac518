"""The page as a person meets it: in a real browser, against a real server that gets killed."""

import json
import os
import re
from pathlib import Path

import numpy as np
import pytest
from live_server import LiveServer

from misstep import demonstrate, load_dataset, load_run, make_system, save_dataset
from misstep.live.picture import show_system
from misstep.mixture import (
    Conditioner,
    DonutMixture,
    GaussianMixture,
    exploration_from_variance,
)
from misstep.systems.gymnasium_adapter import KNOWN

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


def open_page(browser, server, size=(1280, 720), script="", **options):
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]}, accept_downloads=True, **options
    )
    context.set_default_timeout(PATIENCE)
    context.add_init_script(script)
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
    text = page.locator("#notice span").inner_text()
    assert "\n" not in text.strip()


def test_an_attempt_is_marked_and_cut_while_it_is_replayed(page, server, tmp_path):
    take_over(page)
    have_attempts(page, tmp_path)
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


def take_over(page):
    """Have this page drive, with nothing going on."""
    if page.locator("#take").count():
        page.click("#take")
    page.wait_for_selector("#actions button")
    for key, present in (("Escape", "#stop"), ("Backspace", "#discard")):
        if page.locator(present).count():
            page.keyboard.press(key)
            expect(page.locator(present)).to_have_count(0)
    page.wait_for_selector("#begin")


def have_attempts(page, folder):
    """Drop recordings in unless there are some."""
    if page.locator("#attempts .n").count() == 0:
        file = folder / "weak.h5"
        save_dataset(demonstrate(make_system("cartpole"), by="weak", n=3, seed=0), file)
        page.set_input_files("#file", file)
        expect(page.locator("#attempts .n")).to_have_count(3)


def set_slider(page, name, value):
    page.locator(f"#{name}").evaluate(
        "(e, value) => { e.value = value; e.dispatchEvent(new Event('input')) }", value
    )


PAD = """
globalThis.pad = null;
navigator.getGamepads = () => [null, globalThis.pad];
globalThis.hold = (axes, ...pressed) => {
    globalThis.pad = {
        connected: true, axes,
        buttons: Array.from({length: 17}, (_, i) => ({pressed: pressed.includes(i), value: 0})),
    };
};
"""


def test_a_gamepad_drives_and_lets_go_when_it_is_unplugged(browser, server):
    page = open_page(browser, server, script=PAD)
    take_over(page)
    set_slider(page, "strength", 50)
    set_slider(page, "speed", 0)  # so slow that it does not fall before all has been tried
    set_slider(page, "countdown", 0)
    force = page.locator("#hud b").nth(2)
    page.evaluate("hold([0, 0], 0)")  # A starts
    page.wait_for_selector("#fail")
    for axes, pressed, shown in [
        ([-0.6, 0.9], [], "−6.0 N"),
        ([0.05, 0], [], "0.0 N"),  # nobody touches it
        ([0, 0], [15], "+10.0 N"),
        ([0.5, 0], [14], "−10.0 N"),
        ([1.0, 0], [], "+10.0 N"),
    ]:
        page.evaluate("([axes, pressed]) => hold(axes, ...pressed)", [axes, pressed])
        expect(force).to_have_text(shown)
    page.evaluate("pad = null")
    expect(force).to_have_text("0.0 N")
    page.evaluate("hold([0, 0], 3)")  # Y: it has failed
    page.wait_for_selector("#keep")
    page.evaluate("hold([0, 0], 1)")  # B throws it away
    page.wait_for_selector("#begin")
    assert page.faults == []
    page.context.close()


def test_fingers_on_a_phone_push_until_they_are_lifted(browser, server):
    page = open_page(browser, server, PHONE, has_touch=True, is_mobile=True)
    take_over(page)
    for name, value in (("strength", 50), ("speed", 0), ("countdown", 0)):
        set_slider(page, name, value)
    expect(page.locator("#speed-out")).to_have_text("0.02 ×")
    # A browser on a busy machine cancels fingers by itself, and says so.
    page.evaluate("addEventListener('pointercancel', () => { window.cancelled = true; }, true)")
    for _ in range(10):
        if push_with_fingers(page):
            break
    else:
        raise AssertionError("the browser cancelled the fingers ten times")
    expect(page.locator("#hud b").nth(2)).to_have_text("0.0 N")
    page.locator("#fail").tap()
    page.locator("#discard").tap()
    page.wait_for_selector("#begin")
    assert page.evaluate("visualViewport.scale") == 1
    assert page.faults == []
    page.context.close()


def push_with_fingers(page):
    """Push right, leave the pad, push left too, lift one; return whether the browser went along."""
    devtools = page.context.new_cdp_session(page)

    def middle(name):
        box = page.locator(f"#{name}").bounding_box()
        return {"x": box["x"] + box["width"] / 2, "y": box["y"] + box["height"] / 2}

    def touch(kind, *points):
        fingers = [{**point, "id": n} for n, point in points]
        devtools.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": fingers})

    def pushes(text):
        page.wait_for_function(
            "text => window.cancelled || document.querySelectorAll('#hud b')[2].innerText === text",
            arg=text,
        )
        return not page.evaluate("window.cancelled")

    page.evaluate("window.cancelled = false")
    page.locator("#pad-right").scroll_into_view_if_needed()
    right = middle("pad-right")
    away = {"x": right["x"] - 90, "y": right["y"] - 160}
    touch("touchStart", (0, right))  # a push starts an attempt
    page.wait_for_selector("#fail")
    went_along = pushes("+10.0 N")
    touch("touchMove", (0, away))  # off the pad, still down
    left = middle("pad-left")  # it may have moved when the attempt began
    touch("touchStart", (0, away), (1, left))
    went_along = went_along and pushes("0.0 N")
    touch("touchEnd", (0, away))  # the first finger has gone
    went_along = went_along and pushes("−10.0 N")
    touch("touchEnd")
    return went_along


def test_everything_is_reached_with_the_keyboard_alone(page, tmp_path):
    take_over(page)
    have_attempts(page, tmp_path)
    page.locator("body").evaluate("e => { e.tabIndex = -1; e.focus() }")
    seen = {}
    for _ in range(60):
        page.keyboard.press("Tab")
        name, outline = page.evaluate(
            """() => {
                const e = document.activeElement, style = getComputedStyle(e);
                return [e.id || e.parentElement?.id || e.getAttribute("aria-label") || e.tagName,
                        parseFloat(style.outlineWidth) * (style.outlineStyle !== "none")];
            }"""
        )
        if name in seen and name == "system":
            break
        seen.setdefault(name, outline)
    wanted = "system save-menu theme help stage begin strength speed angle countdown upload"
    wanted += " learner more learn column measure costs"
    assert set(wanted.split()) <= set(seen)
    assert min(seen[name] for name in wanted.split()) >= 2

    # A slider stays in hand, and the arrows that set it do not drive.
    page.focus("#strength")
    before = int(page.locator("#strength").input_value())
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowLeft")
    expect(page.locator("#strength-out")).to_have_text(f"{before - 10} %")
    assert page.locator("#begin").count() == 1

    # The chart: the last one is chosen, and opened.
    page.focus("#costs")
    page.keyboard.press("End")
    assert "Enter opens it" in page.locator("#costs").get_attribute("aria-label")
    page.keyboard.press("Enter")
    page.wait_for_selector("#player", state="visible")
    page.keyboard.press("Escape")
    page.wait_for_selector("#player", state="hidden")


def set_playback(page, value):
    page.locator("#playback").evaluate(
        "(e, value) => { e.value = value; e.dispatchEvent(new Event('change')) }", value
    )


def test_a_tab_that_takes_over_goes_on_with_what_is_being_learned(browser, server, tmp_path):
    first = open_page(browser, server)
    take_over(first)
    have_attempts(first, tmp_path)
    set_playback(first, "0.1")  # so slow that there is time to pause it
    first.select_option("#learner", "random-linear")
    first.locator("#more summary").click()
    first.fill("#max-trials", "2")
    first.locator("#more summary").click()
    first.click("#learn")
    first.wait_for_selector("#player", state="visible")
    first.keyboard.press("Space")
    expect(first.locator("#play")).not_to_have_class(re.compile("playing"))
    second = open_page(browser, server)
    set_playback(second, "4")
    # It has watched the first trial to its end, which does not count while another one drives.
    expect(second.locator("#clock")).to_have_text(re.compile(r"(\d+\.\d\d) of \1 s"))
    expect(second.locator("#notice")).to_contain_text("Another tab drives")
    assert "Trial 1" in second.locator("#sentence").inner_text()
    second.click("#take")
    expect(second.locator("#sentence")).to_contain_text("Trial 2")
    second.wait_for_selector("#learn", state="visible")
    assert first.faults == second.faults == []
    first.context.close()
    second.context.close()


def test_every_system_is_drawn(page):
    rng = np.random.default_rng(0)
    names = ["cartpole", "cartpole-rail", "cartpole-swingup", "flipup", "basket"]
    names += [f"gym:{name}" for name in (*KNOWN, "Reacher-v5")]  # one of unknown columns, too
    for name in names:
        judge = {"success": "o0 > 2"} if name.endswith("Reacher-v5") else {}
        system = make_system(name, **judge)
        observation, _ = system.reset(seed=0)
        shown = json.loads(json.dumps(show_system(name, system)))
        space = system.action_space
        action = rng.uniform(np.maximum(space.low, -1e3), np.minimum(space.high, 1e3))
        inked = page.evaluate(
            """async ([system, observation, action]) => {
                const { Stage } = await import("misstep/stage.js");
                const canvas = document.createElement("canvas");
                canvas.style.cssText = "position: fixed; width: 400px; height: 300px";
                document.body.append(canvas);
                const stage = new Stage(canvas);
                stage.use(system);
                stage.draw({ observation, action, time: 0, step: 0 });
                const pixels = canvas.getContext("2d").getImageData(0, 0, 400, 300).data;
                canvas.remove();
                return pixels.filter((value, i) => i % 4 === 3 && value > 0).length;
            }""",
            [shown, observation.tolist(), action.tolist()],
        )
        assert inked > 1000, name
