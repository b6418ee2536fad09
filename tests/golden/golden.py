"""Compare what two states of the code write for the same command lines.

    python tests/golden/golden.py BASE            # the files here against commit BASE
    python tests/golden/golden.py BASE --only render --keep build/golden

Every command line of `commands.toml` runs with the code of both states, side by side, on inputs
made once; exit codes, printed text and all files written are compared. Times and fingerprints are
left out, as its section `left_out` says. Where a change renames a flag, a file or a key, its
section `renamed` says so. Bytes are equal on one machine only, so that no result is kept.

Exit codes: 0 equal; 1 some command differs, as listed; 2 BASE cannot be checked out.
"""

import argparse
import difflib
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parents[2]
TABLE = Path(__file__).with_name("commands.toml")
SECONDS = 600
DIFFERENCES_SHOWN = 12
TEXT = {".json", ".jsonl", ".yaml", ".md", ".html", ".csv", ".txt", ".tex", ".svg", ".log", ".toml"}


@dataclass(frozen=True)
class Ran:
    """One command line that ran: its exit code, what it printed, and the files it left."""

    code: int
    printed: str
    files: dict[str, bytes]


def checked_out(base: str, folder: Path) -> Path:
    """Return a copy of the project at commit `base`, with the bundles that git ignores."""
    archive = subprocess.run(["git", "archive", base], cwd=ROOT, capture_output=True, check=True)
    folder.mkdir(parents=True)
    subprocess.run(["tar", "-x", "-C", str(folder)], input=archive.stdout, check=True)
    ignored = subprocess.run(
        ["git", "ls-files", "--others", "--ignored", "--exclude-standard", "gesturekit"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    ).stdout.splitlines()  # fmt: skip
    for name in ignored:
        if "node_modules" not in name and not name.endswith(".pyc"):
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / name)
    return folder


def environment(tree: Path, sandbox: Path) -> dict[str, str]:
    """Return the variables under which a tree's commands run, one thread each."""
    return {
        **os.environ,
        "PYTHONPATH": str(tree),
        "PYTHONDONTWRITEBYTECODE": "1",
        "GESTUREKIT_CACHE": str(sandbox / ".cache"),
        "CUDA_VISIBLE_DEVICES": "",
        "OMP_NUM_THREADS": "1",
        "COLUMNS": "100",
        "NO_COLOR": "1",
    }


def command_lines(text: str) -> list[list[str]]:
    """Return the arguments of each line of a block; lines may hold comments."""
    lines = (shlex.split(line, comments=True) for line in text.splitlines())
    return [line for line in lines if line]


def renamed_flags(arguments: list[str], flags: dict[str, str]) -> list[str]:
    """Return a command line in the spelling of BASE, given {flag here: flag at BASE}."""
    return [flags.get(argument, argument) for argument in arguments]


def make_inputs(folder: Path, block: str) -> None:
    """Make recordings, sounds and tables with the code here; both states get copies."""
    folder.mkdir(parents=True)
    script = Path(__file__).with_name("inputs.py")
    env = environment(ROOT, folder)
    subprocess.run([sys.executable, str(script)], cwd=folder, env=env, check=True)
    for arguments in command_lines(block):
        subprocess.run(
            [sys.executable, "-m", "gesturekit", *arguments], cwd=folder, env=env, check=True,
            stdout=subprocess.DEVNULL,
        )  # fmt: skip
    shutil.rmtree(folder / ".cache", ignore_errors=True)


def run_lines(tree: Path, sandbox: Path, lines: list[list[str]]) -> Iterator[Ran]:
    """Run command lines one after the other in a folder, with the code of a tree."""
    seen = files_of(sandbox)
    for arguments in lines:
        try:
            done = subprocess.run(
                [sys.executable, "-m", "gesturekit", *arguments],
                cwd=sandbox, env=environment(tree, sandbox), timeout=SECONDS,
                stdout=subprocess.PIPE, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL,
            )  # fmt: skip
            code, printed = done.returncode, done.stdout.decode("utf-8", "replace")
        except subprocess.TimeoutExpired:
            code, printed = -1, f"still running after {SECONDS} s"
        now = files_of(sandbox)
        new = {name: data for name, data in now.items() if seen.get(name) != data}
        seen = now
        for folder, name in ((sandbox, "SANDBOX"), (tree, "TREE")):
            printed = printed.replace(str(folder), name)
            new = {
                path: data.replace(os.fsencode(folder), name.encode())
                if Path(path).suffix in TEXT
                else data
                for path, data in new.items()
            }
        yield Ran(code, printed, new)


def files_of(folder: Path) -> dict[str, bytes]:
    """Return {relative path: content} of all files but those of the cache."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and ".cache" not in path.parts
    }


def without(value: Any, keys: set[str]) -> Any:
    """Return JSON without the values of these keys, at any depth."""
    if isinstance(value, dict):
        return {key: without(inner, keys) for key, inner in value.items() if key not in keys}
    if isinstance(value, list):
        return [without(inner, keys) for inner in value]
    return value


def lines_of(name: str, data: bytes, table: dict[str, Any]) -> list[str] | None:
    """Return the comparable lines of a file, None for a binary file."""
    keys, suffix = set(table["left_out"]["keys"]), Path(name).suffix
    if suffix == ".npz":
        return list(array_lines(data))
    if suffix not in TEXT:
        return None
    text = data.decode("utf-8", "replace")
    if suffix in (".json", ".jsonl"):
        whole = [text] if suffix == ".json" else text.splitlines()
        text = "\n".join(json.dumps(without(json.loads(one), keys), indent=1) for one in whole)
    return cleaned(text, table)


def array_lines(data: bytes) -> Iterator[str]:
    """Yield a line for each array of an npz file: name, type, shape and content."""
    with np.load(io.BytesIO(data), allow_pickle=False) as arrays:
        for name in sorted(arrays.files):
            array = arrays[name]
            digest = hashlib.sha256(array.tobytes()).hexdigest()[:12]
            yield f"{name} {array.dtype} {array.shape} {digest}"


def cleaned(text: str, table: dict[str, Any]) -> list[str]:
    """Return the lines of a text without times and fingerprints."""
    for pattern in table["left_out"]["patterns"]:
        text = re.sub(pattern, "…", text)
    return text.splitlines()


def differences(base: Ran, here: Ran, table: dict[str, Any]) -> Iterator[str]:
    """Yield a line for each difference between what a command left at BASE and here."""
    if base.code != here.code:
        yield f"exit code {base.code} -> {here.code}"
    before = renamed_text(base.printed, table)
    yield from changed(cleaned(before, table), cleaned(here.printed, table), "printed")
    ignored = table["left_out"]["files"]
    old = {renamed_text(name, table): data for name, data in base.files.items()}
    for name in sorted(old.keys() | here.files.keys()):
        if any(fnmatch(name, pattern) for pattern in ignored):
            continue
        if name not in here.files or name not in old:
            yield f"{name}: only {'at BASE' if name in old else 'here'}"
            continue
        if old[name] == here.files[name]:
            continue
        first, second = (lines_of(name, data, table) for data in (old[name], here.files[name]))
        if first is None or second is None:
            yield f"{name}: other bytes"
            continue
        first = renamed_text("\n".join(first), table).splitlines()
        yield from changed(first, second, name)


def renamed_text(text: str, table: dict[str, Any]) -> str:
    """Return a text of BASE with the names of here."""
    for before, after in table["renamed"]["texts"].items():
        text = text.replace(before, after)
    return text


def changed(before: list[str], after: list[str], what: str) -> Iterator[str]:
    """Yield the lines that two texts do not share."""
    for line in difflib.unified_diff(before, after, lineterm="", n=0):
        if line[:1] in "+-" and line[:3] not in ("+++", "---"):
            yield f"{what}: {line[:200]}"


def compare(base: str, only: str, keep: Path) -> int:
    """Run all command lines with both states and print what differs; return how many differ."""
    table = tomllib.loads(TABLE.read_text(encoding="utf-8"))
    written = table["commands"]
    for name, settings in table["settings"].items():
        written = written.replace(f"{{{name}}}", settings)
    lines = [line for line in command_lines(written) if only in " ".join(line)]
    make_inputs(keep / "inputs", table["inputs"])
    trees = [checked_out(base, keep / "tree_of_base"), ROOT]
    boxes = [keep / "run_of_base", keep / "run_of_here"]
    for box in boxes:
        shutil.copytree(keep / "inputs", box)
    flags = table["renamed"]["flags"]
    asked = [[renamed_flags(line, flags) for line in lines], lines]
    differing = 0
    with ThreadPoolExecutor(2) as both:
        pairs = [run_lines(*arguments) for arguments in zip(trees, boxes, asked)]
        for number, line in enumerate(lines, 1):
            ran = list(both.map(next, pairs))
            found = list(differences(*ran, table))
            differing += bool(found)
            state = f"{len(found)} differences" if found else f"equal, exit code {ran[1].code}"
            print(f"{number:3}/{len(lines)} {' '.join(line)[:90]}: {state}", flush=True)
            for text in found[:DIFFERENCES_SHOWN]:
                print(f"        {text}", flush=True)
    print(f"{len(lines) - differing} of {len(lines)} command lines left the same")
    return differing


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("base", help="the commit to compare with")
    parser.add_argument("--only", default="", help="command lines that contain this text")
    parser.add_argument("--keep", type=Path, help="new folder for all files; removed without it")
    args = parser.parse_args()
    known = subprocess.run(
        ["git", "rev-parse", "--verify", "-q", f"{args.base}^{{commit}}"], cwd=ROOT,
        capture_output=True,
    )  # fmt: skip
    if known.returncode:
        parser.error(f"{args.base} is no commit of this repository")
    if args.keep:
        sys.exit(bool(compare(args.base, args.only, args.keep.resolve())))
    with tempfile.TemporaryDirectory() as folder:
        sys.exit(bool(compare(args.base, args.only, Path(folder))))


if __name__ == "__main__":
    main()
