"""Self-contained HTML pages of one look: pictures and videos inside, nothing fetched from outside.

A page is a Jinja template of the package that includes ``page.css``, the look that they share.
"""

import base64
from pathlib import Path

import jinja2
from markupsafe import Markup

_MIME = {".png": "image/png", ".mp4": "video/mp4"}


def render_page(template: str, **values: object) -> str:
    """Return a page.

    Parameters
    ----------
    template : str
        Its path in the package: ``"paper/report.html.j2"``.
    **values
        What the template names; text in them is escaped.
    """
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("misstep", ""),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
    )
    return environment.get_template(template).render(values)


def data_url(path: Path) -> Markup:
    """Return a picture (PNG) or a video (MP4) as an address that holds it."""
    content = base64.b64encode(path.read_bytes()).decode("ascii")
    return Markup(f"data:{_MIME[path.suffix]};base64,{content}")  # noqa: S704 - base64 is inert
