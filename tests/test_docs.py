"""Documentation: every command and snippet is checked, every link leads somewhere."""

import ast
import importlib
import importlib.util
import re
import shlex
from pathlib import Path
from types import ModuleType

import click
import numpy as np
import pytest
from PIL import Image

import audio_features as af
import gesturekit as gk
from gesturekit.cli import VERBS, cli
from gesturekit.diffusion import DiffusionConfig
from gesturekit.evaluation import DEFINITIONS
from gesturekit.multires import MultiresConfig
from gesturekit.training.config import load_config, read_chain
from gesturekit.training.recipes import find_config

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted(ROOT.glob("docs/**/*.md")),
    *sorted(ROOT.glob("recipes/*/README.md")),
]
SCHEMAS = {"multires": MultiresConfig, "diffusion": DiffusionConfig}


def name_of(page: Path) -> str:
    return page.relative_to(ROOT).as_posix()


def blocks(page: Path, *languages: str) -> list[str]:
    """Return the fenced code blocks in one of these languages; "" for none."""
    found = re.findall(
        r"^```(\w*)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL
    )
    return [code for language, code in found if language in languages]


def commands(page: Path) -> list[str]:
    whole = page.read_text(encoding="utf-8")
    indented = re.findall(r"^    .*$", whole, re.MULTILINE)
    text = "\n".join([*blocks(page, "", "bash", "sh"), *indented]).replace("\\\n", " ")
    # An array task of SLURM is one number.
    return [
        line.strip().removeprefix("$ ").replace("$SLURM_ARRAY_TASK_ID", "1")
        for line in text.splitlines()
    ]


# With the group's settings: click keeps the help option that a command was first asked for.
CONTEXT = click.Context(cli, info_name="gesturekit", **cli.context_settings)


def command_of(verb: str) -> click.Command:
    return cli.get_command(CONTEXT, verb)


def script(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", ROOT / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def hooks() -> ModuleType:
    return script("hooks")


def check_command(line: str) -> None:
    """Check that a verb has these options, and that a named config exists and has these keys."""
    line = re.sub(r"\|\| true$", "", line)
    line = line.removeprefix(".venv/bin/")
    line = re.sub(r"^torchrun .* -m gesturekit", "gesturekit", line)
    if not line.startswith("gesturekit "):
        return
    _, verb, *arguments = shlex.split(line, comments=True)
    if arguments[:1] == ["..."] or verb == "VERB":
        return
    assert verb in VERBS, line
    parameters = command_of(verb).make_context(verb, arguments, parent=CONTEXT).params
    config = parameters.get("config")
    if verb == "train" and not parameters["resume"] and config.name not in ("my_recipe", "..."):
        file = find_config(ROOT / config if (ROOT / config).is_file() else config)
        overrides = [text for text in parameters["overrides"] if text != "..."]
        load_config(file, SCHEMAS[read_chain(file)["system"]], overrides)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_command_lines_are_valid(page):
    for line in commands(page):
        check_command(line)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_verbs_and_options_in_sentences_exist(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for line in re.findall(r"`gesturekit\s+([a-z][^`]*)`", text):
        verb, *words = line.split()
        assert verb in VERBS, line
        command = command_of(verb)
        if isinstance(command, click.Group) and words and words[0] in command.commands:
            command = command.commands[words[0]]
        known = {
            option
            for parameter in command.params
            for option in (*parameter.opts, *parameter.secondary_opts)
        }
        assert {word for word in words if word.startswith("--")} <= {*known, "--help"}, line


@pytest.mark.parametrize("verb", VERBS)
def test_the_examples_in_the_help_are_valid(verb):
    command = command_of(verb)
    shown = " ".join(
        command.get_help(click.Context(command, info_name=verb, parent=CONTEXT)).split()
    )
    lines = [line.removeprefix("Example: ") for line in command.epilog.splitlines() if line]
    assert lines and all(" ".join(line.split()) in shown for line in lines), verb
    for line in lines:
        assert line.startswith(f"gesturekit {verb} ")
        check_command(line)


def test_places_that_the_page_of_the_papers_names_exist():
    """`module:object`, or a module, in the last column of a table."""
    text = (ROOT / "docs" / "papers.md").read_text(encoding="utf-8")
    cells = re.findall(r"^\|.*\| ([^|]*) \|$", text, re.MULTILINE)
    places = [place for cell in cells for place in re.findall(r"`([a-z_.]+:?[\w.]*)`", cell)]
    assert places
    for place in places:
        module, _, names = place.partition(":")
        if not module.startswith("audio_features"):
            module = f"gesturekit.{module}"
        found = importlib.import_module(module)
        for name in names.split(".") if names else ():
            found = getattr(found, name)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_scripts_and_make_targets_exist(page):
    targets = re.findall(r"^([a-z]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    for line in commands(page):
        if match := re.match(r"python (\S+\.py)", line):
            assert (ROOT / match[1]).is_file(), line
        if match := re.match(r"make (\w+)", line):
            assert match[1] in targets, line


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_python_snippets_compile_and_use_names_that_exist(page):
    for code in blocks(page, "python"):
        tree = ast.parse(code)
        packages = {"gk": gk, "af": af}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom):
                module = importlib.import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), code
            elif isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                package = packages.get(node.value.id)
                assert package is None or hasattr(package, node.attr), f"{code}: {node.attr}"


def anchors(page: Path) -> set[str]:
    """Return the anchors of a page's headings, as GitHub and mkdocs make them."""
    headings = re.findall(r"^#+ (.*)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    plain = (re.sub(r"[^\w\s-]", "", heading.lower()).strip() for heading in headings)
    return {re.sub(r"\s+", "-", heading) for heading in plain}


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_links_lead_somewhere(page):
    made = re.findall(
        r'"(\w+)": \w+,$', (ROOT / "docs/pictures.py").read_text("utf-8"), re.MULTILINE
    )
    generated = {f"pictures/{name}.png" for name in made}
    text = re.sub(r"```.*?```|`[^`\n]*`", "", page.read_text(encoding="utf-8"), flags=re.DOTALL)
    for link in re.findall(r"\]\(([^)\s]+)\)", text):
        if link.startswith("https://") or (page.parent.name == "docs" and link in generated):
            continue
        target, _, anchor = link.partition("#")
        there = (page.parent / target).resolve() if target else page
        assert there.exists(), f"{name_of(page)}: {link}"
        assert not anchor or anchor in anchors(there), f"{name_of(page)}: {link}"


def test_every_page_is_in_the_navigation_and_on_the_first_page():
    navigation = (ROOT / "mkdocs.yml").read_text(encoding="utf-8").split("\nnav:")[1]
    first = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    for page in (ROOT / "docs").glob("*.md"):
        assert f": {page.name}\n" in navigation, f"mkdocs.yml: {page.name}"
        assert f"]({page.name})" in first or page.name == "index.md", f"index.md: {page.name}"


def test_every_public_name_is_in_the_reference(hooks):
    packages = {
        ".".join(path.parent.relative_to(ROOT).parts)
        for root in ("gesturekit", "audio_features")
        for path in (ROOT / root).rglob("__init__.py")
        if "__all__" in path.read_text(encoding="utf-8")
    }
    assert set(hooks.PACKAGES) == packages
    for package in hooks.PACKAGES:
        page = hooks.python_page(package)
        for name in importlib.import_module(package).__all__:
            assert f"heading: {name}\n" in page or f"\n## {name}\n" in page
    assert "[gesturekit.motion.motion.Motion]" in hooks.python_page("gesturekit.motion")
    names = hooks.public_names("audio_features")
    assert names["Wave"] == "audio_features.wave.Wave"


def test_the_pages_of_commands_and_metrics_have_all_of_them(hooks):
    page = hooks.commands_page()
    for verb in VERBS:
        assert re.search(rf"^#+ {verb}$", page, re.M) and f"Usage: gesturekit {verb} " in page
    page = hooks.metrics_page()
    assert all(f"`{key}`" in page for key in DEFINITIONS)


def test_pages_show_every_picture_that_is_made_and_it_is_a_picture(tmp_path):
    """Those that need the demo model are made by `make docs`."""
    pictures = script("pictures").PICTURES
    shown = "".join(page.read_text(encoding="utf-8") for page in (ROOT / "docs").glob("*.md"))
    assert all(f"(pictures/{name}.png)" in shown for name in pictures)
    for name in ("alternation", "guidance", "experts"):
        pictures[name](tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_the_picture_of_the_readme_moves_and_is_small():
    (name,) = re.findall(r"\]\((docs/\S+\.webp)\)", (ROOT / "README.md").read_text("utf-8"))
    assert (ROOT / name).stat().st_size < 1_000_000
    with Image.open(ROOT / name) as picture:
        assert picture.is_animated
        shown = []
        for frame in (0, picture.n_frames // 2):
            picture.seek(frame)
            shown.append(np.asarray(picture.convert("L"), float))
    assert (abs(shown[0] - shown[1]) > 50).mean() > 0.02, "the body does not move"
