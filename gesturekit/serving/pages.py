"""Pages of the service, which load nothing from elsewhere."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import Any

from gesturekit.serving.requests import Limits

DROP_PAGE = (Path(__file__).parent / "page" / "drop.html").read_text(encoding="utf-8")
"""Page on which one drops a sound and sees the motion."""
PAGE_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; "
        "img-src data: blob:; media-src data: blob:; connect-src 'self' data: blob:; "
        "frame-src blob:; worker-src blob:; base-uri 'none'; form-action 'none'; "
        "frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
}
_STYLE = (
    "body{font:16px/1.5 system-ui,sans-serif;max-width:50em;margin:2em auto;padding:0 1em;"
    "color:#222}table{border-collapse:collapse}td,th{text-align:left;padding:.2em 1em .2em 0;"
    "vertical-align:top}code,pre{background:#f2f2f2;padding:.1em .3em}"
)


def api_page(schema: dict[str, Any], limits: Limits) -> str:
    """Return a page of the operations in an OpenAPI schema."""
    parts = [f"<h1>{escape(schema['info']['title'])}</h1>"]
    for path, operations in schema["paths"].items():
        for method, about in operations.items():
            parts.append(_operation(f"{method.upper()} {path}", about))
    shown = "".join(_row(name, str(value)) for name, value in vars(limits).items())
    parts.append(f"<h2>Limits</h2><table>{shown}</table>")
    parts.append('<p>Machine-readable: <a href="openapi.json">openapi.json</a></p>')
    example = "curl --data-binary @speech.wav 'http://127.0.0.1:8000/motion?format=bvh' > a.bvh"
    body = "".join(parts) + f"<pre>{escape(example)}</pre>"
    return f"<!doctype html><meta charset=utf-8><title>API</title><style>{_STYLE}</style>{body}"


def _operation(name: str, about: dict[str, Any]) -> str:
    rows = [
        _row(
            parameter["name"],
            f"{parameter.get('description', '')} {_kind(parameter.get('schema', {}))}",
        )
        for parameter in about.get("parameters", ())
    ]
    rows += [_row(status, said["description"]) for status, said in about["responses"].items()]
    return f"<h2>{escape(name)}</h2><p>{escape(about.get('description', ''))}</p>" + (
        f"<table>{''.join(rows)}</table>"
    )


def _kind(schema: dict[str, Any]) -> str:
    values = schema.get("enum") or [option.get("type") for option in schema.get("anyOf", ())]
    default = f"; default {schema['default']}" if "default" in schema else ""
    return f"({', '.join(map(str, values)) or schema.get('type', '')}{default})"


def _row(name: str, text: str) -> str:
    return f"<tr><th>{escape(name)}</th><td>{escape(text)}</td></tr>"
