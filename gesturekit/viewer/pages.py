"""Common parts of HTML pages: templates, scripts, and sections of reports."""

from __future__ import annotations

import base64
import html
import json
import os
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from audio_features.atomic import write_text
from gesturekit.errors import GestureKitError


def write_page(path: str | os.PathLike[str], folder: Path, values: Mapping[str, str]) -> None:
    """Write the page of the template.html and style.css of a folder; for `values` see `filled`."""
    write_text(path, filled(folder, values))


def filled(folder: Path, values: Mapping[str, str]) -> str:
    """Return template.html of a folder with `{{style}}`, its style.css, and `{{name}}` of `values`.

    All in one pass, so that inserted values are not searched; other placeholders stay.
    """
    template, style = (
        (folder / name).read_text(encoding="utf-8") for name in ("template.html", "style.css")
    )
    return insert(template, {"style": style, **values})


def insert(text: str, values: Mapping[str, str]) -> str:
    """Replace the placeholders `{{name}}` of `values` in one pass."""
    return re.sub(r"\{\{(\w+)\}\}", lambda place: values.get(place[1], place[0]), text)


def script_json(value: object) -> str:
    """Return a value as JSON that may stand in a script element."""
    # "<" only occurs inside strings of JSON; escaped, no string can end the script element.
    return json.dumps(value, separators=(",", ":")).replace("<", "\\u003c")


@cache
def bundled_script(path: Path, what: str) -> str:
    """Return a script of `make setup`; `what` names it in the GestureKitError if it is missing."""
    if not path.is_file():
        raise GestureKitError(f"{what} is missing: `make setup` makes {path} in a checkout")
    # The HTML parser ends a script at these letters wherever they stand.
    return re.sub(r"</(?=script)", r"<\\/", path.read_text(encoding="utf-8"), flags=re.I)


def section(title: str, lead: str, body: str) -> str:
    """Return a section of a report; `lead` and `body` are HTML."""
    lead = f'<p class="lead">{lead}</p>' if lead else ""
    return f"<section><h2>{html.escape(title)}</h2>{lead}{body}</section>"


def plots_section(plots: Mapping[str, str]) -> str:
    """Return the section of SVG figures {title: text}."""
    figures = "".join(
        f"<figure><figcaption>{html.escape(title)}</figcaption>"
        f'<img alt="{html.escape(title)}" src="data:image/svg+xml;base64,'
        f'{base64.b64encode(svg.encode()).decode()}"></figure>'
        for title, svg in plots.items()
    )
    return section("Plots", "", figures) if figures else ""
