"""A session as one HTML file: the same page, with everything in it and nobody behind it."""

import base64
import json
import re
from importlib.resources import files
from typing import Any

PAGE = files("misstep.live").joinpath("page")
MODULES = (
    "actions.js",
    "app.js",
    "attempts.js",
    "cartpole.js",
    "chart.js",
    "columns.js",
    "density.js",
    "dialogs.js",
    "dom.js",
    "figures.js",
    "files.js",
    "gymnasium.js",
    "hand.js",
    "hud.js",
    "input.js",
    "learning.js",
    "library.js",
    "link.js",
    "marks.js",
    "model.js",
    "notice.js",
    "path.js",
    "pen.js",
    "plane.js",
    "player.js",
    "settings.js",
    "stage.js",
    "striking.js",
    "theme.js",
    "viewer.js",
    "words.js",
)
"""Modules of the page; each is imported as ``misstep/NAME``."""


def import_map(addresses: dict[str, str]) -> str:
    """Return the import map of the page."""
    return json.dumps({"imports": {f"misstep/{name}": addresses[name] for name in MODULES}})


def page_html(imports: str, style: str, start: str, replay: str) -> str:
    """Return the page.

    Parameters
    ----------
    imports : str
        Its import map, JSON.
    style, start : str
        Elements that style it and that start it.
    replay : str
        JSON of what is replayed; ``null`` for the live page.
    """
    html = PAGE.joinpath("index.html").read_text(encoding="utf-8")
    parts = {"IMPORTS": imports, "STYLE": style, "START": start, "REPLAY": _inert(replay)}
    return re.sub(r"<!--(IMPORTS|STYLE|START|REPLAY)-->", lambda m: parts[m[1]], html)


def replay_html(session: dict[str, Any], recordings: list[str], trials: list[str]) -> str:
    """Return a page that replays a session on its own.

    Parameters
    ----------
    session : dict
        As the page is told.
    recordings, trials : list of str
        JSON of the demonstrations and the trials.
    """
    addresses = {name: _data_address(name) for name in MODULES}
    style = PAGE.joinpath("style.css").read_text(encoding="utf-8")
    told = json.dumps(session, allow_nan=False)
    replay = (
        f'{{"session":{told},"recordings":[{",".join(recordings)}],"trials":[{",".join(trials)}]}}'
    )
    start = '<script type="module">import "misstep/app.js";</script>'
    return page_html(import_map(addresses), f"<style>{style}</style>", start, replay)


def _data_address(name: str) -> str:
    script = PAGE.joinpath(name).read_bytes()
    return "data:text/javascript;base64," + base64.b64encode(script).decode("ascii")


def _inert(text: str) -> str:
    """Return JSON that cannot end the element that it stands in."""
    return text.replace("<", "\\u003c")
