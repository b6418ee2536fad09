"""Imports point one way, as CONTRIBUTING.md says; functions stay small, docstrings plain."""

import ast
import re
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse.csgraph import connected_components

ROOT = Path(__file__).resolve().parents[1]

# Packages that each package of gesturekit may import beside itself, audio_features and the modules
# that every package may import. Imports inside functions count too.
MAY_IMPORT: dict[str, set[str]] = {"motion": set(), "jobs": set()}
MAY_IMPORT["formats"] = {"motion"}
MAY_IMPORT["face"] = {"motion"}
MAY_IMPORT["conversion"] = {"formats", "jobs", "motion"}
MAY_IMPORT["postprocess"] = {"motion"}
for _package in ("corpus", "evaluation", "viewer"):
    MAY_IMPORT[_package] = {"formats", "motion"}
MAY_IMPORT["evaluation"] |= {"corpus", "viewer"}  # its report embeds the player
MAY_IMPORT["training"] = {"corpus", "evaluation", "formats", "jobs", "motion", "viewer"}
MAY_IMPORT["training"] |= {"face", "model", "state"}
MAY_IMPORT["state"] = {"corpus", "motion"}
MAY_IMPORT["multires"] = {"model", "postprocess", "state", "training", *MAY_IMPORT["training"]}
MAY_IMPORT["diffusion"] = MAY_IMPORT["multires"]
MAY_IMPORT["inspection"] = {"systems", "diffusion", *MAY_IMPORT["multires"]}
MAY_IMPORT["rendering"] = {"jobs", "systems", "multires", "diffusion", *MAY_IMPORT["multires"]}
MAY_IMPORT["study"] = {"corpus", "evaluation", "formats", "motion", "training", "viewer"}
MAY_IMPORT["serving"] = {"model", "systems"}
MAY_IMPORT["live"] = {"face", "formats", "model", "motion", "serving", "viewer"}
MAY_IMPORT["cli"] = {"conversion", "study", "diagnosis", "inspection", "live", "serving"}
MAY_IMPORT["cli"] |= {"rendering", *MAY_IMPORT["rendering"]}
# Modules outside of any package. `systems` imports models and trainers by name, lazily.
MAY_IMPORT["model"] = {"corpus", "motion"}
MAY_IMPORT["systems"] = {"model", "training"}
MAY_IMPORT["diagnosis"] = {"formats", "systems"}
EVERYONE_MAY_IMPORT = {"errors", "compiled", "field_docs", "lazy", "progress", "wording"}
EVERYONE_MAY_IMPORT |= {"workers"}
MAY_IMPORT |= {module: set() for module in EVERYONE_MAY_IMPORT}

# Files in which a string may name a module that is imported on demand.
LAZY_IMPORTS = {
    "audio_features/kinds.py",  # a group of entry points
    "gesturekit/cli/__init__.py",
    "gesturekit/evaluation/definitions.py",
    "gesturekit/formats/registry.py",
    "gesturekit/systems.py",
}


def sources(package: str) -> list[Path]:
    files = [
        path for path in sorted((ROOT / package).rglob("*.py")) if "node_modules" not in path.parts
    ]
    assert files, package
    return files


@cache
def nodes(path: Path) -> tuple[ast.AST, ...]:
    return tuple(ast.walk(ast.parse(path.read_text(encoding="utf-8"))))


@cache
def imported(path: Path) -> list[tuple[int, str]]:
    """Return (line, dotted name) of everything that a file imports, inside functions too."""
    package, found = path.relative_to(ROOT).parent.parts, []
    for node in nodes(path):
        if isinstance(node, ast.Import):
            found += [(node.lineno, alias.name) for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*above, *(node.module.split(".") if node.module else ())])
            # `from gesturekit import multires` imports a module too.
            found += [(node.lineno, f"{module}.{alias.name}") for alias in node.names]
    return found


def package_of(path: Path) -> str:
    inside = path.relative_to(ROOT / "gesturekit")
    return inside.parts[0] if len(inside.parts) > 1 else inside.stem


def test_every_package_is_in_the_table_and_on_the_map():
    packages = {package_of(path) for path in sources("gesturekit")} - {"__init__", "__main__"}
    assert packages == set(MAY_IMPORT), "a new package needs a line here and in CONTRIBUTING.md"
    contributing = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    for name in packages - EVERYONE_MAY_IMPORT:
        assert re.search(rf"`(gesturekit/)?{name}(/|\.py)`", contributing), (
            f"{name} is not on the map"
        )


def test_imports_within_gesturekit_point_downwards():
    wrong = []
    for path in sources("gesturekit"):
        importer = package_of(path)
        if importer in ("__init__", "__main__"):
            continue
        allowed = MAY_IMPORT[importer] | EVERYONE_MAY_IMPORT | {importer}
        for line, name in imported(path):
            package, _, rest = name.partition(".")
            if package == "gesturekit" and rest.split(".")[0] not in allowed:
                wrong.append(f"{path.relative_to(ROOT)}:{line}: {importer} imports {name}")
    assert not wrong, "\n".join(wrong)


def module_paths() -> dict[str, Path]:
    paths = {}
    for path in [*sources("audio_features"), *sources("gesturekit")]:
        parts = path.relative_to(ROOT).with_suffix("").parts
        paths[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return paths


def lines_for_types(path: Path) -> set[int]:
    """Return the lines below `if TYPE_CHECKING`: a value may be annotated by whoever samples it."""
    blocks = [node for node in nodes(path) if isinstance(node, ast.If)]
    blocks = [block for block in blocks if ast.unparse(block.test) == "TYPE_CHECKING"]
    return {line for block in blocks for line in range(block.lineno, block.body[-1].end_lineno + 1)}


def module_imports(paths: dict[str, Path]) -> dict[str, set[str]]:
    """Return which modules each module imports, inside functions too, but not for types alone."""
    edges: dict[str, set[str]] = {module: set() for module in paths}
    for module, path in paths.items():
        types = lines_for_types(path)
        for line, name in imported(path):
            if line in types:
                continue
            # The name may be a module, or a name defined in its parent module.
            target = name if name in paths else name.rpartition(".")[0]
            edges[module] |= {target} & (paths.keys() - {module})
    return edges


def import_cycles(edges: dict[str, set[str]]) -> list[set[str]]:
    modules = sorted(edges)
    graph = np.array([[other in edges[module] for other in modules] for module in modules])
    n_groups, group = connected_components(graph, connection="strong")
    groups = [{m for m, g in zip(modules, group) if g == k} for k in range(n_groups)]
    return [found for found in groups if len(found) > 1]


def sibling_imports(edges: dict[str, set[str]], package: str) -> dict[str, set[str]]:
    """Return which children of a package, files and folders, import which of their siblings."""
    inner: dict[str, set[str]] = {}
    for module, targets in edges.items():
        if not module.startswith(f"{package}."):
            continue
        child = module[len(package) + 1 :].split(".")[0]
        inner.setdefault(child, set())
        for target in targets:
            if target.startswith(f"{package}."):
                inner[child] |= {target[len(package) + 1 :].split(".")[0]} - {child}
    return inner


def test_no_import_leads_back_to_where_it_started():
    """Forbid import cycles between modules, and between the files and folders of each package."""
    paths = module_paths()
    edges = module_imports(paths)
    wrong = [f"modules: {', '.join(sorted(cycle))}" for cycle in import_cycles(edges)]
    for package in (name for name, path in paths.items() if path.stem == "__init__"):
        if siblings := sibling_imports(edges, package):
            wrong += [f"{package}: {', '.join(sorted(c))}" for c in import_cycles(siblings)]
    assert not wrong, "\n".join(wrong)


def test_audio_features_stands_alone():
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: imports {name}"
        for path in sources("audio_features")
        for line, name in imported(path)
        if name.split(".")[0] == "gesturekit"
    ]
    assert not wrong, "\n".join(wrong)


@pytest.mark.parametrize("package", ["audio_features", "gesturekit"])
def test_only_the_dispatch_tables_name_modules_by_string(package):
    wrong = []
    for path in sources(package):
        where = path.relative_to(ROOT).as_posix()
        for node in nodes(path):
            is_name = (
                isinstance(node, ast.Constant)
                and isinstance(node.value, str)
                and re.fullmatch(r"gesturekit(\.\w+)+\.?(:\w+)?", node.value)
            )
            if is_name and where not in LAZY_IMPORTS:
                wrong.append(f"{where}:{node.lineno}: {node.value!r}")
    assert not wrong, "\n".join(wrong)


def test_nothing_names_a_path_of_one_machine():
    wrong = [
        f"{path.relative_to(ROOT)}: {found[0]}"
        for package in ("audio_features", "gesturekit", "tests", "recipes", "benchmarks")
        for path in sorted((ROOT / package).rglob("*"))
        if path.suffix in (".py", ".yaml", ".md", ".js") and "node_modules" not in path.parts
        if (found := re.search(r"/(work|home|root|Users)/\w+", path.read_text(encoding="utf-8")))
    ]
    assert not wrong, "\n".join(wrong)


AVOIDED = set("of what that how whose whether which where to in by for with".split())  # noqa: SIM905
DOCUMENTED = (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)


@pytest.mark.parametrize("package", ["audio_features", "gesturekit"])
def test_docstrings_begin_with_a_verb_or_noun_phrase(package):
    wrong = []
    for path in sources(package):
        for node in nodes(path):
            text = isinstance(node, DOCUMENTED) and ast.get_docstring(node)
            if text and re.match(r"\W*(\w+)", text)[1].lower() in AVOIDED:
                line = text.splitlines()[0]
                wrong.append(f"{path.relative_to(ROOT)}:{node.body[0].lineno}: {line}")
    assert not wrong, "\n".join(wrong)


MAX_FUNCTION_LINES, MAX_PARAMETERS = 60, 8


def test_functions_and_signatures_are_small():
    """The options of a click command are not its parameters."""
    wrong = []
    for path in [*sources("audio_features"), *sources("gesturekit")]:
        where = path.relative_to(ROOT)
        for node in nodes(path):
            if isinstance(node, ast.FunctionDef):
                if (n := node.end_lineno - node.lineno + 1) > MAX_FUNCTION_LINES:
                    wrong.append(f"{where}: {node.name} has {n} lines")
                args = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
                if (n := len([a for a in args if a.arg not in ("self", "cls")])) > MAX_PARAMETERS:
                    wrong.append(f"{where}: {node.name} has {n} parameters")
    assert not wrong, "\n".join(wrong)
