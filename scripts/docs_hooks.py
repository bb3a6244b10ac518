"""What the documentation shows and nobody types twice: MkDocs calls these while it builds.

A page says what it wants in a comment of its own line, ``<!-- generated: parameters donut -->``.
Pictures in SVG are put into the page itself, so that they take its colours, light or dark.
"""

import json
import re
import tomllib
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"

_MARK = re.compile(r"^<!-- generated: (\S+)(.*?) -->$", re.MULTILINE)
_SVG = re.compile(r'<img alt="([^"]*)" src="([^":]*/)?([\w-]+\.svg)" ?/?>')


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Put what is generated in the place of its mark."""
    up = "../" * page.file.src_uri.count("/")
    return _MARK.sub(lambda mark: generated(mark[1], mark[2].split(), up), deepened(markdown))


def deepened(markdown: str) -> str:
    """Indent what belongs to an item of a numbered list by four spaces, where three are usual."""
    lines, inside = [], False
    for line in markdown.splitlines():
        inside = bool(re.match(r"\d\. ", line)) or (inside and line[:3].strip() == "")
        lines.append(f" {line}" if inside and line.startswith("   ") else line)
    return "\n".join(lines)


def on_page_content(html: str, **_: Any) -> str:
    """Put SVG pictures into the page."""
    return _SVG.sub(lambda image: _inline(DOCS / "images" / image[3], image[1]), html)


def generated(what: str, arguments: Iterable[str], up: str = "") -> str:
    """Return the Markdown of one mark.

    Parameters
    ----------
    what : str
        A name of `GENERATORS`.
    arguments : iterable of str
    up : str
        From the page to the folder of all pages: ``"../"``.
    """
    return GENERATORS[what](*arguments).replace("](docs:", f"]({up}")


def table(titles: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table."""
    titles = list(titles)
    lines = [titles, ["---"] * len(titles), *rows]
    cells = ([str(cell).replace("|", r"\|") for cell in line] for line in lines)
    return "\n".join(f"| {' | '.join(line)} |" for line in cells)


def parameters(learner: str) -> str:
    """Return the table of a learner's parameters."""
    from misstep import LEARNERS
    from misstep.parameters import parameter_table

    rows = [
        (f"`{row.name}`", f"`{row.default}` {row.unit}".rstrip(), row.meaning)
        for row in parameter_table(LEARNERS[learner])
    ]
    return table(("parameter", "default", "meaning"), rows)


def learners() -> str:
    """Return the table of all learners, rung by rung."""
    from misstep import LEARNERS

    kinds = sorted(LEARNERS.items(), key=lambda item: item[1].rung)
    rows = [
        (kind.rung, f"[`{name}`](docs:learners/{name}.md)", _summary(kind).partition(": ")[2])
        for name, kind in kinds
    ]
    return table(("rung", "learner", "what it does"), rows)


def systems() -> str:
    """Return the table of all systems."""
    from misstep import SYSTEMS

    columns = ("system", "what it is")
    return table(columns, ((f"`{name}`", _summary(kind)) for name, kind in SYSTEMS.items()))


def demonstrators() -> str:
    """Return the table of all demonstrators."""
    from misstep import DEMONSTRATORS

    columns = ("kind", "how it fails")
    return table(columns, ((f"`{name}`", _summary(kind)) for name, kind in DEMONSTRATORS.items()))


def formats() -> str:
    """Return the table of all formats."""
    from misstep import FORMATS

    rows = []
    for name, entry in FORMATS.items():
        can = [word for word in ("read", "write") if getattr(entry, word) is not None]
        suffixes = " ".join(f"`{s}`" for s in (*entry.suffixes, *entry.read_suffixes))
        needs = f"`misstep[{entry.extra}]`" if entry.extra else ""
        rows.append((f"`{name}`", ", ".join(can), suffixes, needs, entry.description))
    return table(("format", "can", "suffix", "needs", "what it is"), rows)


def results(learner: str) -> str:
    """Return the rows of docs/results.md that measure a learner."""
    rows = [row for row in result_rows() if re.match(rf"`{learner}( |`)", row["learner"])]
    if not rows:
        return "The study of [the results](docs:results.md) does not include it."
    titles = [title for title in rows[0] if title != "is told"]
    found = table(titles, ([row[title] for title in titles] for row in rows))
    return f"{found}\n\nFrom [the results](docs:results.md), which say how this was measured."


@cache
def result_rows() -> tuple[Mapping[str, str], ...]:
    """Return the rows of the first table of docs/results.md, each with its task."""
    lines = (DOCS / "results.md").read_text(encoding="utf-8").split("\n\n")
    block = next(text for text in lines if text.startswith("| task"))
    titles, _, *rows = ([c.strip() for c in line.split("|")[1:-1]] for line in block.splitlines())
    filled, task = [], ""
    for row in rows:
        task = row[0] or task
        filled.append(dict(zip(titles, [task, *row[1:]], strict=True)))
    return tuple(filled)


def commands() -> str:
    """Return the help of every command."""
    import typer

    from misstep.cli.app import app

    return "\n\n".join(
        f"## `{command.path}`\n\n```text\n{command.help}\n```"
        for command in _commands(typer.main.get_command(app), "misstep")
    )


@dataclass(frozen=True)
class _Command:
    path: str
    help: str


def _commands(command: Any, path: str) -> Iterable[_Command]:
    inner = getattr(command, "commands", None)
    if inner is None or path == "misstep":
        with command.make_context(path, ["--help"], resilient_parsing=True) as context:
            yield _Command(path, command.get_help(context))
    for name, member in (inner or {}).items():
        yield from _commands(member, f"{path} {name}")


def claims(*sections: str) -> str:
    """Return the verdicts on the paper's claims of some sections."""
    return "\n\n".join(
        f'<div class="claim" markdown>\n'
        f'<span class="verdict {claim["verdict"].replace(" ", "-")}">{claim["verdict"]}</span>\n\n'
        f"**{claim['sentence']}**\n\n"
        f"{claim['measured']}\n{{: .measured }}\n\n"
        f"Judged by: {claim['how']}\n{{: .how }}\n\n</div>"
        for claim in _paper()["claims"]
        if claim["section"] in sections
    )


def verdicts() -> str:
    """Return how many claims of the paper, and of ours about it, got which verdict."""
    counts = Counter((c["section"] == "ours", c["verdict"]) for c in _paper()["claims"])
    names = sorted({verdict for _, verdict in counts}, key=lambda v: -counts[False, v])
    rows = [(name, counts[False, name], counts[True, name]) for name in names]
    return table(("verdict", "the paper's claims", "our own about it"), rows)


def costs() -> str:
    """Return the mean costs of the demonstrations and of the explorations, the paper's and ours."""
    tables = _paper()["tables"]
    rows = []
    for what, key, mean in (
        ("demonstrations (table I)", "I", "mean"),
        ("explorations without reward (table II)", "II", "mean_of_all"),
    ):
        printed = [sum(column) / len(column) for column in zip(*tables[key]["paper"], strict=True)]
        pairs = zip(printed, tables[key][mean], strict=True)
        rows.append((what, *(f"{theirs:.0f} / {ours:.0f}" for theirs, ours in pairs)))
    return table(("mean cost, paper / ours [deg]", "30 s", "15 s", "7.5 s"), rows)


def variants() -> str:
    """Return a row for each way in which the experiment was run."""
    rows = [
        (row["title"], *(f"{cost:.0f}" for cost in row["mean_costs"]), _of(row))
        for row in _paper()["tables"]["variants"]
    ]
    return table(("variant", "30 s [deg]", "15 s [deg]", "7.5 s [deg]", "succeeded"), rows)


def rooms() -> str:
    """Draw the layers of imports that pyproject.toml states, the outer ones on top."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    (layers,) = (
        contract["layers"]
        for contract in project["tool"]["importlinter"]["contracts"]
        if contract["type"] == "layers"
    )
    rows = (
        "".join(f"<code>{name}</code>" for name in re.split(r"[ |:]+", layer)) for layer in layers
    )
    return f'<div class="rooms">{"".join(f"<div>{row}</div>" for row in rows)}</div>'


def include(path: str) -> str:
    """Return a Markdown file of the repository's root, its links made to lead somewhere here."""
    text = (ROOT / path).read_text(encoding="utf-8")
    text = re.sub(r"\]\(docs/", "](docs:", text)
    return text.replace("](CHANGELOG.md)", "](docs:changelog.md)")


GENERATORS: Mapping[str, Callable[..., str]] = {
    function.__name__: function
    for function in (
        parameters,
        learners,
        systems,
        demonstrators,
        formats,
        results,
        commands,
        claims,
        verdicts,
        costs,
        variants,
        rooms,
        include,
    )
}


@cache
def _paper() -> Any:
    """Return what scripts/docs_paper.py took from a reproduction."""
    return json.loads((DOCS / "assets" / "paper.json").read_text(encoding="utf-8"))


def _of(row: Mapping[str, int]) -> str:
    return f"{row['successes']} of {row['explorations']}"


def _summary(kind: type) -> str:
    return (kind.__doc__ or "").strip().partition("\n")[0]


@cache
def _inline(path: Path, alt: str) -> str:
    svg = path.read_text(encoding="utf-8")
    return svg.replace("<svg ", f'<svg role="img" aria-label="{alt}" ', 1)
