"""The documentation does what it says.

Every block of code in README.md and docs/ is run, in order, a page in a folder of its own: Python
in one namespace, shell commands with the real ``misstep``. A block with a title is a file, and is
written; a ``pyproject.toml`` among them is laid out as pip would. A ``text`` block below is what
the block above printed, where three dots stand for anything.

What cannot run here says so in the line above it, ``<!-- not run: why -->``.
"""

import json
import os
import re
import subprocess
import sys
import textwrap
import tomllib
from collections import Counter
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib import util
from pathlib import Path
from threading import Thread
from urllib.parse import unquote

import numpy as np
import pytest
import yaml

from misstep import LEARNERS, DonutMixture, DonutShape, GaussianMixture
from misstep.mixture import Conditioner, exploration_from_variance
from misstep.paper.claims import TESTS
from misstep.paper.synthetic import run_synthetic
from misstep.parameters import parameter_table

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]
CHROMIUM = Path(os.environ.get("CHROMIUM", "/usr/bin/chromium"))

# Whole pages whose commands other tests run.
ELSEWHERE = {
    "README.md": "sh: make, and recordings of the reader's own",
    "docs/live.md": "a browser and a person: tests/test_live*.py",
    "docs/reliability.md": "hours of crashes and fuzzing",
    "docs/robot.md": "ROS, robots, Gazebo: tests/test_ros*.py, test_robot*.py, test_gazebo.py",
}

_BLOCK = re.compile(
    r"(?:^ *<!-- not run: (?P<reason>[^\n]+?) -->\n)?"
    r"^(?P<indent> *)```(?P<language>\w*)(?: title=\"(?P<title>[^\"]+)\")?[^\n]*\n"
    r"(?P<code>.*?)^(?P=indent)```$",
    re.MULTILINE | re.DOTALL,
)


@dataclass(frozen=True)
class Block:
    language: str
    code: str
    title: str | None
    reason: str | None
    line: int


def blocks_of(page):
    text = page.read_text(encoding="utf-8")
    name = str(page.relative_to(ROOT))
    for match in _BLOCK.finditer(text):
        reason = match["reason"]
        if reason is None and (name != "README.md" or match["language"] == "sh"):
            reason = ELSEWHERE.get(name)
        yield Block(
            match["language"],
            textwrap.dedent(match["code"]),
            match["title"],
            reason,
            text.count("\n", 0, match.start("indent")) + 1,
        )


def is_run(block):
    return block.reason is None and block.language in ("python", "sh")


def hook(name):
    """Import a module of scripts/."""
    spec = util.spec_from_file_location(name, ROOT / "scripts" / f"{name}.py")
    module = util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# What runs the Python of a page: one process, one namespace, a block a line.
_INTERPRETER = """
import contextlib, io, json, sys, traceback
space = {"__name__": "page"}
for line in sys.stdin:
    said = io.StringIO()
    try:
        with contextlib.redirect_stdout(said):
            exec(compile(json.loads(line), "page", "exec"), space)
        answer = {"said": said.getvalue()}
    except BaseException:
        answer = {"error": traceback.format_exc()}
    print(json.dumps(answer), flush=True)
"""


class Reader:
    """Follows a page, block by block."""

    def __init__(self, folder):
        self.folder = folder
        self.packages = []
        self.interpreter = None

    @property
    def environment(self):
        path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
        packages = os.pathsep.join(str(package) for package in self.packages)
        return {
            **os.environ,
            "PATH": path,
            "PYTHONPATH": packages,
            "COLUMNS": "100",
            "MPLBACKEND": "Agg",
        }

    def write(self, title, code):
        file = self.folder / title
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(code, encoding="utf-8")
        if file.name == "pyproject.toml":
            self.install(file)

    def install(self, pyproject):
        project = tomllib.loads(pyproject.read_text(encoding="utf-8"))["project"]
        name, version = project["name"], project["version"]
        told = pyproject.parent / f"{name.replace('-', '_')}-{version}.dist-info"
        told.mkdir()
        (told / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
        groups = [
            "\n".join([f"[{group}]", *(f"{key} = {value}" for key, value in points.items())])
            for group, points in project["entry-points"].items()
        ]
        (told / "entry_points.txt").write_text("\n".join(groups) + "\n")
        self.packages.append(pyproject.parent)

    def shell(self, code):
        done = subprocess.run(
            ["bash", "-euo", "pipefail", "-c", code],
            cwd=self.folder,
            env=self.environment,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, f"{code}\n{done.stdout}\n{done.stderr}"
        return done.stdout

    def python(self, code):
        if self.interpreter is None:
            self.interpreter = subprocess.Popen(
                [sys.executable, "-W", "error", "-c", _INTERPRETER],
                cwd=self.folder,
                env=self.environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        print(json.dumps(code), file=self.interpreter.stdin, flush=True)
        answer = json.loads(self.interpreter.stdout.readline())
        assert "error" not in answer, f"{code}\n{answer['error']}"
        return answer["said"]

    def close(self):
        if self.interpreter is not None:
            self.interpreter.stdin.close()
            self.interpreter.wait()
            self.interpreter.stdout.close()


def says(expected, printed):
    """Whether the printed lines are the expected ones, three dots being any."""
    pattern = r"\n".join(
        r"(?:.*\n)*?.*"
        if line.strip() == "..."
        else re.escape(line.strip()).replace(r"\.\.\.", ".*")
        for line in expected.strip("\n").splitlines()
    )
    lines = "\n".join(re.sub(" +", " ", line).strip() for line in printed.strip("\n").splitlines())
    pattern = re.sub(r"(\\ )+", r"\\ ", pattern)
    return re.fullmatch(r"(?:.*\n)*?" + pattern + r"(?:\n.*)*", lines) is not None


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if any(is_run(block) for block in blocks_of(page))],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_the_code_of_a_page_runs(page, tmp_path):
    reader = Reader(tmp_path)
    printed = None
    try:
        for block in blocks_of(page):
            where = f"{page.name}, line {block.line}"
            if block.reason is not None:
                printed = None
            elif block.title is not None:
                reader.write(block.title, block.code)
            elif block.language == "python":
                printed = reader.python(block.code)
            elif block.language == "sh":
                printed = reader.shell(block.code)
            elif block.language == "text":
                assert printed is not None, f"{where}: nothing printed this"
                assert says(block.code, printed), f"{where}: printed was\n{printed}"
            else:
                pytest.fail(f"{where}: nobody knows how to run {block.language!r}; say not run")
    finally:
        reader.close()


def test_expected_output_can_be_told_from_other_output():
    assert says("a  b\n...\nd", "x\na b\nc\nc\nd\n")
    assert says("a ... c", "a b c")
    assert not says("a\n...\ne", "a\nb\nc\n")
    assert not says("a b", "a c")


def test_what_does_not_run_says_why_and_is_little(capsys):
    everything = [(page, block) for page in PAGES for block in blocks_of(page)]
    run = [block for _, block in everything if is_run(block)]
    not_run = [(page, block) for page, block in everything if block.reason is not None]
    here = [block for page, block in not_run if str(page.relative_to(ROOT)) not in ELSEWHERE]
    with capsys.disabled():
        print(f"\ndocumentation: {len(run)} blocks run, {len(not_run)} not:")
        for (page, reason), n in Counter((page, block.reason) for page, block in not_run).items():
            print(f"  {n} of {page.relative_to(ROOT)}: {reason}")
    assert len(run) >= 40
    assert len(here) <= 10
    assert all(len(block.reason) > 5 for _, block in not_run)


def test_every_learner_has_a_page_that_states_its_rung_and_parameters():
    nav = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    generated = hook("docs_hooks").generated
    own = [name for name in LEARNERS if LEARNERS[name].__module__.startswith("misstep.")]
    assert len(own) == 15
    for name in own:
        text = (DOCS / "learners" / f"{name}.md").read_text(encoding="utf-8")
        assert text.startswith(f"# `{name}`\n\n**Rung {LEARNERS[name].rung}: ")
        assert f"<!-- generated: parameters {name} -->" in text
        assert f"<!-- generated: results {name} -->" in text
        assert f"learners/{name}.md" in nav
        table = generated("parameters", [name])
        for row in parameter_table(LEARNERS[name]):
            default = f"`{row.default}` {row.unit}".rstrip()
            assert f"| `{row.name}` | {default} | {row.meaning} |" in table
    pages = {page.stem for page in (DOCS / "learners").glob("*.md")} - {"index"}
    assert pages == set(own)


def test_measured_rows_are_those_of_the_results_page():
    hooks = hook("docs_hooks")
    text = (DOCS / "results.md").read_text(encoding="utf-8")
    assert (
        len(hooks.result_rows())
        == sum(line.startswith(("| ", "|  |")) for line in text.split("## ")[0].splitlines()) - 1
    )  # the titles
    rows = hooks.generated("results", ["donut"])
    assert rows.count("donut by path") == 2
    assert "29 of 600" in rows
    assert "basket" in rows
    assert "donut-incremental" not in rows


def test_the_claims_are_those_that_misstep_judges():
    shown = json.loads((DOCS / "assets" / "paper.json").read_text(encoding="utf-8"))["claims"]
    assert [(c["section"], c["sentence"]) for c in shown] == [
        (t.section, t.sentence) for t in TESTS
    ]
    page = (DOCS / "paper.md").read_text(encoding="utf-8")
    told = re.findall(r"<!-- generated: claims (\S+) -->", page)
    assert sorted(told) == sorted({test.section for test in TESTS})


def test_items_of_numbered_lists_keep_what_belongs_to_them():
    text = "1. one\n\n   ```sh\n   a\n   ```\n\n2. two\nlazy\n   code"
    deeper = "1. one\n\n    ```sh\n    a\n    ```\n\n2. two\nlazy\n   code"
    assert hook("docs_hooks").deepened(text) == deeper


def test_tables_of_docstrings_become_markdown():
    markdown = hook("docs_docstrings").markdown
    rule = "====  =====\n"
    table = (
        f"Before::\n\n{rule}name  what\n{rule}a     first\n      line\nb     other\n{rule}\nAfter"
    )
    assert markdown(table) == (
        "Before:\n\n\n| name | what |\n| --- | --- |\n| a | first line |\n| b | other |\n\n\nAfter"
    )


# --------------------------------------------------------------------------------- the donut


@pytest.fixture(scope="module")
def browser():
    if not CHROMIUM.exists():
        pytest.skip("the donut is tried in Chromium: apt-get install chromium, or set CHROMIUM")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as play:
        running = play.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield running
        running.close()


@pytest.fixture
def donut_page(browser):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_content("<div data-donut></div>")
    page.add_script_tag(path=DOCS / "assets" / "donut.js")
    yield page
    page.close()


def mixture_of(parts):
    columns = zip(*((p["weight"], p["mean"], p["covariance"]) for p in parts), strict=True)
    return GaussianMixture.from_parameters(*(list(column) for column in columns))


_ASK = """([which, states, epsilons, reach, actions]) => {
    const { conditional, moments, donutShape, density, exploration, modes, DATA, K } = misstepDonut;
    const { mixture, scale } = DATA[which];
    return states.map((state, i) => {
        const usual = conditional(mixture, state);
        const shape = donutShape(epsilons[i], K, reach);
        const { mean, variance } = moments(usual);
        return {
            usual, shape, mean, variance,
            exploration: exploration(variance, scale),
            density: actions.map((a) => density(usual, shape, a)),
            modes: modes(usual, shape),
        };
    });
}"""


@pytest.mark.parametrize("which", [0, 1, 2])
@pytest.mark.parametrize("reach", [1.0, 2.0, 3.0])
def test_the_page_s_donut_is_misstep_s(donut_page, which, reach):
    rng = np.random.default_rng(which)
    states = np.append(rng.uniform(-170, 170, 20), 0.0)
    epsilons = np.append(rng.uniform(0, 1, 19), [0.0, 1.0])
    actions = np.linspace(-40, 40, 33)
    data = donut_page.evaluate("() => misstepDonut.DATA")[which]
    told = donut_page.evaluate(
        _ASK, [which, states.tolist(), epsilons.tolist(), reach, actions.tolist()]
    )
    mixture = mixture_of(data["mixture"])
    conditioner = Conditioner(mixture, [0])
    for state, epsilon, here in zip(states, epsilons, told, strict=True):
        usual = conditioner.at([state])
        donut = DonutMixture(usual, epsilon, k=2.0, reach=reach)
        for key, ours in (
            ("weight", usual.weights),
            ("mean", usual.means[:, 0]),
            ("variance", usual.covariances[:, 0, 0]),
        ):
            np.testing.assert_allclose([c[key] for c in here["usual"]], ours, rtol=1e-9, atol=1e-12)
        shape = DonutShape.of(epsilon, 1, reach=reach)
        theirs = [here["shape"][key] for key in ("gamma", "alpha", "beta")]
        np.testing.assert_allclose(theirs, shape, rtol=1e-12)
        np.testing.assert_allclose(here["mean"], usual.mean[0], atol=1e-9)
        np.testing.assert_allclose(here["variance"], usual.variance[0, 0], rtol=1e-9)
        wanted = exploration_from_variance(usual.variance, [data["scale"]])
        np.testing.assert_allclose(here["exploration"], wanted, rtol=1e-9)
        np.testing.assert_allclose(
            here["density"], donut.pdf(actions[:, None]), rtol=1e-7, atol=1e-14
        )
        # Ours is one of theirs, and theirs is at least as high: they look everywhere.
        deviation = np.sqrt(usual.covariances.max())
        mode = donut.mode()
        assert np.min(np.abs(np.array(here["modes"]) - mode)) < 1e-4 * deviation
        best = donut.pdf([[here["modes"][0]]])[0]
        assert best >= donut.pdf(mode[None])[0] * (1 - 1e-9)
        everywhere = donut.pdf(np.linspace(-150, 150, 6001)[:, None])
        assert best >= everywhere.max() * (1 - 1e-9)


def test_the_page_s_made_up_data_is_what_misstep_fits(donut_page):
    shown = mixture_of(donut_page.evaluate("() => misstepDonut.DATA[2].mixture"))
    fitted = run_synthetic(0).policies[0].mixture
    for name in ("weights_", "means_", "covariances_"):
        np.testing.assert_allclose(getattr(shown, name), getattr(fitted, name), rtol=1e-4)


def test_the_donut_is_driven_by_keys_and_by_dragging(donut_page):
    page = donut_page
    said = page.locator("[role=status]")
    assert said.inner_text().startswith("At 60° the forces spread by 6.5 N: ε = 0.46, 4 modes")
    page.get_by_label("State θ").focus()
    for _ in range(60):
        page.keyboard.press("ArrowLeft")
    assert said.inner_text().startswith("At 0° the forces spread by 2.5 N: ε = 0.11, one mode")
    page.get_by_label("Exploration ε").focus()
    page.keyboard.press("End")
    assert "ε = 1.00, 2 modes" in said.inner_text()
    assert not page.get_by_label("ε follows").is_checked()
    page.get_by_label("ε follows").check()
    assert "ε = 0.11" in said.inner_text()
    page.get_by_label("Data").select_option("the paper's made-up data")
    assert said.inner_text().startswith("At 0° the forces spread by 3.5 N")
    box = page.locator("figure svg").first.bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.3, box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.9, box["y"] + box["height"] / 2, steps=3)
    page.mouse.up()
    assert re.match(r"At 1[2345]\d° ", said.inner_text())


# ---------------------------------------------------------------------------------- the site


class Links(HTMLParser):
    """What a page of the site loads, links to, and can be linked to."""

    def __init__(self, text):
        super().__init__()
        self.loaded, self.links, self.anchors = [], [], {"__top"}
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        given = dict(attrs)
        self.anchors |= {given[key] for key in ("id", "name") if given.get(key)}
        if tag == "a" and given.get("href"):
            self.links.append(given["href"])
        elif tag == "link" and given.get("rel") not in ("canonical", "next", "prev"):
            self.loaded.append(given["href"])
        elif given.get("src"):
            self.loaded.append(given["src"])


def test_the_site_is_whole(tmp_path, browser):
    """It builds strictly, loads nothing from elsewhere, every link leads somewhere, and it fits."""
    site = tmp_path / "site"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(site)],
        cwd=ROOT,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr
    pages = {path: Links(path.read_text(encoding="utf-8")) for path in sorted(site.rglob("*.html"))}
    assert len(pages) >= 45
    for path, page in pages.items():
        if path.name == "404.html":  # served from anywhere, so it links from the root
            continue
        for address in [*page.loaded, *page.links]:
            if re.match(r"https?:|mailto:", address):
                assert address in page.links, f"{path.name} loads {address}"
                continue
            file, _, anchor = unquote(address).partition("#")
            target = (path.parent / file).resolve() if file else path
            assert target.exists(), f"{path.name} links to {address}"
            if anchor and target.suffix == ".html":
                assert anchor in pages[target].anchors, f"{path.name} links to {address}"
    for style in site.rglob("*.css"):
        assert not re.search(r"url\(['\"]?https?:", style.read_text(encoding="utf-8")), style

    with served(site) as address:
        seen = browser.new_page(viewport={"width": 390, "height": 800})
        errors, asked = [], []
        seen.on("pageerror", lambda error: errors.append(str(error)))
        seen.on("request", lambda request: asked.append(request.url))
        for path in pages:
            seen.goto(f"{address}/{path.relative_to(site)}")
            width = seen.evaluate("document.documentElement.scrollWidth")
            assert width <= 390, f"{path.relative_to(site)} is {width} px wide"
        seen.close()
        assert errors == []
        assert all(url.startswith((address, "data:", "blob:")) for url in asked)


@contextmanager
def served(folder):
    """Serve a folder on this machine, and yield its address."""

    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with ThreadingHTTPServer(("127.0.0.1", 0), partial(Quiet, directory=folder)) as server:
        thread = Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}"
        finally:
            server.shutdown()
            thread.join()


def test_the_navigation_names_every_page():
    nav = yaml.safe_load((ROOT / "mkdocs.yml").read_text(encoding="utf-8"))["nav"]

    def pages(entry):
        if isinstance(entry, str):
            return [entry]
        parts = entry.values() if isinstance(entry, dict) else entry
        return [page for part in parts for page in pages(part)]

    named = pages(nav)
    assert len(named) == len(set(named))
    there = {str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md")}
    assert set(named) == there
