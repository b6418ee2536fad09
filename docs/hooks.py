"""Hooks of mkdocs: pictures, commands and the Python reference are made when the site is built.

Recipes' READMEs and CONTRIBUTING.md become pages too. Links in Markdown files are those of the
repository, and are changed to the site's.
"""

from __future__ import annotations

import importlib
import inspect
import posixpath
import re
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]

# Packages whose `__all__` is the public interface.
PACKAGES = (
    "gesturekit",
    "audio_features",
    "gesturekit.motion",
    "gesturekit.motion.parts",
    "gesturekit.motion.retarget",
    "gesturekit.formats",
    "gesturekit.corpus",
    "gesturekit.evaluation",
    "gesturekit.study",
    "gesturekit.postprocess",
    "gesturekit.face",
    "gesturekit.viewer",
    "gesturekit.multires",
    "gesturekit.inspection",
    "gesturekit.live",
)
_LINK = re.compile(r"(\]\()([^)#\s:]+)?(#[^)\s]*)?(\))")


def public_names(package: str) -> dict[str, str]:
    """Return {public name: dotted place of its definition}."""
    module = importlib.import_module(package)
    places = {}
    for name in sorted(module.__all__, key=str.lower):
        found = getattr(module, name)
        if inspect.isclass(found) or inspect.isfunction(found):
            places[name] = f"{found.__module__}.{found.__qualname__}"
        else:
            places[name] = f"{package}.{name}"
    return places


def python_page(package: str) -> str:
    """Return the reference of a package as Markdown.

    What an earlier package exports too is described there.
    """
    before = PACKAGES[: PACKAGES.index(package)]
    elsewhere = {place: name for name in reversed(before) for place in public_names(name).values()}
    doc = (inspect.getdoc(importlib.import_module(package)) or "").splitlines()
    lines = [f"# {package}", "", doc[0] if doc else "", ""]
    for name, place in public_names(package).items():
        if place in elsewhere:
            lines += [f"## {name}", "", f"See [{elsewhere[place]}.{name}][{place}].", ""]
        else:
            lines += [f"::: {place}", "    options:", f"      heading: {name}", ""]
    return "\n".join(lines)


def controls_page() -> str:
    """Return the keywords of `Model.generate` of both systems as Markdown."""
    from gesturekit.systems import SYSTEMS, controls_type

    lines = ["# Controls", "", "Keywords of `Model.generate`, for each system.", ""]
    for kind in SYSTEMS:
        schema = controls_type(kind)
        place = f"{schema.__module__}.{schema.__qualname__}"
        lines += [f"::: {place}", "    options:", f"      heading: {kind}"]
        lines += ["      inherited_members: true", ""]
    return "\n".join(lines)


def metrics_page() -> str:
    """Return the definitions of all metrics as Markdown."""
    from gesturekit.evaluation.definitions import DEFINITIONS, GROUPS, Variants

    lines = ["# All metrics", "", "Frames are counted at 25 fps here.", ""]
    for group in GROUPS:
        lines += [f"## {group}", ""]
        for found in (d.at(25.0, Variants()) for d in DEFINITIONS.values() if d.group == group):
            unit = f", {found.unit}" if found.unit else ""
            lines += [f"### {found.name}{unit}", "", f"`{found.key}`: {found.variant}.", ""]
            lines += [found.text, "", f"Source: {found.source}.", ""]
    return "\n".join(lines)


def commands_page() -> str:
    """Return the help of every command as Markdown."""
    import click

    from gesturekit.cli import VERBS, cli
    from gesturekit.cli.options import ALL_OPTIONS

    lines = [
        "# Commands",
        "",
        "The help of each command with all its options; `gesturekit VERB --help` prints the usual",
        "ones, `--help-all` all of them.",
        "",
    ]
    for verb in VERBS:
        context = click.Context(cli, info_name="gesturekit", **cli.context_settings)
        command = cli.get_command(context, verb)
        inner = click.Context(command, info_name=verb, parent=context, max_content_width=96)
        inner.meta[ALL_OPTIONS] = True
        lines += [f"## {verb}", "", "```text", command.get_help(inner), "```", ""]
    return "\n".join(lines)


def repository_pages() -> dict[str, Path]:
    """Return {place in the site: file} of pages that do not lie in docs/."""
    pages = {f"recipes/{p.parent.name}.md": p for p in sorted(ROOT.glob("recipes/*/README.md"))}
    return {**pages, "contributing.md": ROOT / "CONTRIBUTING.md"}


def site_link(page: str, target: str, pages: dict[str, str]) -> str | None:
    """Return a link of the repository as one of the site; None if the file is not on the site.

    Args:
        page: place of the page in the repository, such as recipes/demo/README.md.
        target: the link, relative to it.
        pages: {place in the repository: place in the site}.
    """
    there = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
    if there not in pages:
        return None
    return posixpath.relpath(pages[there], posixpath.dirname(pages[page]) or ".")


def on_files(files: Any, config: Any) -> Any:
    """Add generated files to those of docs/."""
    import gallery
    from mkdocs.structure.files import File
    from pictures import write_pictures

    made: dict[str, str | bytes] = {f"api/{name}.md": python_page(name) for name in PACKAGES}
    made |= {"cli.md": commands_page(), "api/controls.md": controls_page()}
    made["api/metrics.md"] = metrics_page()
    for place, file in repository_pages().items():
        made[place] = file.read_text(encoding="utf-8")
        for picture in file.parent.glob("*.png"):
            made[f"recipes/{file.parent.name}/{picture.name}"] = picture.read_bytes()
    made["gallery.md"] = gallery.markdown("gallery")
    with tempfile.TemporaryDirectory() as folder:
        write_pictures(Path(folder, "pictures"))
        gallery.write_clips(Path(folder, "gallery"))
        made |= {p.relative_to(folder).as_posix(): p.read_bytes() for p in Path(folder).glob("*/*")}
    for place, content in made.items():
        files.append(File.generated(config, place, content=content))
    config.extra["pages"] = _pages(files)
    return files


def on_config(config: Any) -> Any:
    """Complete the navigation by the pages that are made."""
    import sys

    sys.path[:0] = [str(ROOT / "docs"), str(ROOT)]
    recipes = [{p.stem: place} for place, p in _recipe_places()]
    config.nav += [
        {"Gallery": "gallery.md"},
        {"Recipes": recipes},
        {
            "Reference": [
                {"Commands": "cli.md"},
                {"Controls": "api/controls.md"},
                {"All metrics": "api/metrics.md"},
                *({name: f"api/{name}.md"} for name in PACKAGES),
            ]
        },
        {"Contributing": "contributing.md"},
    ]
    return config


def _recipe_places() -> list[tuple[str, Path]]:
    pages = repository_pages().items()
    return [(place, Path(place)) for place, _ in pages if place.startswith("recipes/")]


def _pages(files: Any) -> dict[str, str]:
    """Return {place in the repository: place in the site} of every page and picture."""
    others = repository_pages()
    places = {f"docs/{f.src_uri}": f.src_uri for f in files if f.src_uri not in others}
    for place, file in others.items():
        places[file.relative_to(ROOT).as_posix()] = place
        for picture in file.parent.glob("*.png"):
            name = picture.relative_to(ROOT).as_posix()
            places[name] = name
    return places


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Change links of the repository to those of the site."""
    pages = config.extra["pages"]
    own = next(name for name, place in pages.items() if place == page.file.src_uri)

    def change(match: re.Match[str]) -> str:
        start, target, anchor, end = match.groups(default="")
        there = site_link(own, target, pages) if target else None
        return f"{start}{there or target}{anchor}{end}"

    return _LINK.sub(change, markdown)
