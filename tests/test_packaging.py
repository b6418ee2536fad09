"""The wheel and the sdist, installed in a fresh environment, work without the checkout."""

import os
import subprocess
import sys
import sysconfig
import tarfile
import tomllib
import zipfile
from pathlib import Path

import pytest
import yaml

import gesturekit
from gesturekit.training.recipes import recipe_table

ROOT = Path(__file__).resolve().parents[1]


def run(*command: object, cwd: Path) -> str:
    keep = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        [str(part) for part in command], cwd=cwd, env=keep, capture_output=True, text=True
    )
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def environment(tmp_path_factory) -> Path:
    """A fresh environment that sees this one's dependencies, but not its gesturekit."""
    folder = tmp_path_factory.mktemp("fresh") / "venv"
    run(sys.executable, "-m", "venv", folder, cwd=folder.parent)
    (site,) = folder.glob("lib/python*/site-packages")
    (site / "dependencies.pth").write_text(sysconfig.get_path("purelib") + "\n")
    pip = [folder / "bin" / "python", "-m", "pip", "install", "-q"]
    run(*pip, "-c", ROOT / "constraints.txt", "hatchling", cwd=folder.parent)
    return folder


@pytest.fixture(scope="module")
def packages(environment, tmp_path_factory) -> dict[str, Path]:
    """The wheel built from the checkout, the sdist, and the wheel built from the sdist."""
    out = tmp_path_factory.mktemp("dist")
    python = environment / "bin" / "python"
    wheel = [python, "-m", "pip", "wheel", "-q", "--no-deps", "--no-build-isolation", "-w"]
    run(*wheel, out / "wheel", ROOT, cwd=out)
    run(python, "-m", "hatchling", "build", "-t", "sdist", "-d", out / "sdist", cwd=ROOT)
    (sdist,) = (out / "sdist").glob("*.tar.gz")
    run(*wheel, out / "again", sdist, cwd=out)
    return {
        "wheel": next((out / "wheel").glob("*.whl")),
        "sdist": sdist,
        "wheel of the sdist": next((out / "again").glob("*.whl")),
    }


def test_the_citation_names_this_version_and_both_papers():
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert cited["version"] == gesturekit.__version__
    authors = [paper["authors"][0]["family-names"] for paper in cited["references"]]
    assert {"Moreno-Villamarín", "Alexanderson"} <= set(authors)


def test_workflow_and_hooks_use_the_versions_of_the_package():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    versions = [c.rpartition(":: ")[2] for c in project["classifiers"] if ":: 3." in c]
    workflow = yaml.safe_load((ROOT / ".github/workflows/tests.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["test"]["strategy"]["matrix"]["python"] == versions
    hooks = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))
    pins = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    assert "ruff==" + hooks["repos"][0]["rev"].removeprefix("v") in pins


@pytest.mark.stress
def test_the_wheel_of_the_sdist_has_the_files_of_the_wheel(packages):
    names = []
    for name in ("wheel", "wheel of the sdist"):
        with zipfile.ZipFile(packages[name]) as archive:
            names.append({n for n in archive.namelist() if ".dist-info" not in n})
    assert names[0] == names[1]
    recipes = {p.relative_to(ROOT).as_posix() for p in ROOT.glob("recipes/*/*") if p.is_file()}
    assert {f"gesturekit/{name}" for name in recipes} <= names[0]
    assert not [name for name in names[0] if "__pycache__" in name or name.startswith("tests")]
    assert packages["wheel"].stat().st_size < 20e6
    with tarfile.open(packages["sdist"]) as archive:
        assert any(name.endswith("tests/test_packaging.py") for name in archive.getnames())


@pytest.mark.stress
def test_an_installed_wheel_works_without_the_checkout(
    packages, environment, write_pair, write_speech, tmp_path
):
    bin_ = environment / "bin"
    wheel = packages["wheel of the sdist"]
    pip = [bin_ / "python", "-m", "pip", "install", "-q", "--no-deps"]
    run(*pip, "--force-reinstall", wheel, cwd=tmp_path)
    gesturekit = bin_ / "gesturekit"
    where = run(
        bin_ / "python", "-c", "import gesturekit; print(gesturekit.__file__)", cwd=tmp_path
    )
    assert Path(where.strip()).is_relative_to(environment)
    run(gesturekit, "demo", "--out", "demo", cwd=tmp_path)
    assert (tmp_path / "demo" / "speech.html").is_file()
    write_speech(tmp_path / "my speech.wav", 2.0, 44100)
    formats = ["--format", "bvh,npz,html,png"]
    run(gesturekit, "render", "my speech.wav", "--model=demo", "--out=out", *formats, cwd=tmp_path)
    run(gesturekit, "view", "out/my speech.bvh", "--out", "view.html", cwd=tmp_path)
    assert "<script" in (tmp_path / "view.html").read_text(encoding="utf-8")
    for k in range(3):
        write_pair(tmp_path / "recordings", f"take {k}", 4.0, seed=k)
    run(gesturekit, "prepare", "recordings", "--out", "corpus.jsonl", cwd=tmp_path)
    run(gesturekit, "recipes", "cp", "own_corpus", "mine", cwd=tmp_path)
    debug = recipe_table()["debug"]["multires"]
    for config, out in (("mine", "runs/copy"), ("multires_speech/light", "runs/shipped")):
        run(gesturekit, "train", config, "corpus=corpus.jsonl", f"out={out}", *debug, cwd=tmp_path)
        assert (tmp_path / out / "model" / "model.safetensors").is_file()
