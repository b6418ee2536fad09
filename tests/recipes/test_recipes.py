"""Every configuration in recipes/ trains for two steps a pair, through the command line."""

from __future__ import annotations

import shlex
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import gesturekit as gk
from gesturekit.cli import main
from gesturekit.corpus import Manifest, prepare
from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import load_config, read_chain

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "recipes").glob("*/*.yaml"))
SCRIPTS = sorted(
    path for path in (ROOT / "recipes").glob("*/*.py") if "__main__" in path.read_text("utf-8")
)

# What makes a recipe of each system a matter of a second. What a recipe is about (features, losses,
# steps, noise, FiLM, joints) stays as it is.
TINY = {
    "multires": (
        "threads=1",
        "network.levels=4",
        "network.channels=[2,2]",
        "network.embedding=4",
        "training.first_stage=2",
        "training.further_stages=2",
        "training.batch=2",
        "training.window=2",
        "training.window_cache=2",
    ),
    "diffusion": (
        "threads=1",
        "network.blocks=2",
        "network.layers=1",
        "network.channels=8",
        "network.heads=2",
        "network.feedforward=8",
        "network.embedding=8",
        "training.updates=2",
        "training.batch=2",
        "training.window=2",
    ),
}
CONFIG_CLASSES = {"multires": MultiresConfig, "diffusion": DiffusionConfig}


@pytest.fixture(scope="module")
def wavlm(tmp_path_factory, write_wavlm) -> Path:
    folder = tmp_path_factory.mktemp("wavlm")
    write_wavlm(folder)
    return folder


def with_styles(corpus: Path, path: Path) -> Path:
    """The same corpus, its recordings in two styles by turns."""
    items = [
        replace(item, style=("calm", "lively")[number % 2])
        for number, item in enumerate(Manifest.load(corpus))
    ]
    Manifest(items).save(path)
    return path


def with_events(corpus: Path, path: Path) -> Path:
    """The same corpus, with something that happens in each recording."""
    events = path.with_suffix(".csv")
    events.write_text("time,name\n0.5,kick\n1.0,kick\n", encoding="utf-8")
    items = [replace(item, conditions={"events": events}) for item in Manifest.load(corpus)]
    Manifest(items).save(path)
    return path


@pytest.fixture(scope="module")
def idle(tmp_path_factory, gesture) -> Path:
    """A manifest of motion alone."""
    folder = tmp_path_factory.mktemp("idle")
    gesture(4.0, 24.0, seed=7).save(folder / "idle.bvh")
    prepare([], folder / "idle.jsonl", unpaired_motion=[folder], holdout=0.0)
    return folder / "idle.jsonl"


def name_of(path: Path) -> str:
    return path.relative_to(ROOT / "recipes").as_posix()


def test_there_are_recipes():
    assert {"demo/config.yaml", "multires_speech/config.yaml", "multires_speech/light.yaml"} <= {
        name_of(path) for path in CONFIGS
    }


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_the_recipe_trains_and_its_model_moves(path, corpus, wavlm, idle, tmp_path):
    system = read_chain(path)["system"]
    if "styles" in read_chain(path):
        corpus = with_styles(corpus, tmp_path / "styles.jsonl")
    if read_chain(path).get("events"):
        corpus = with_events(corpus, tmp_path / "events.jsonl")
    config = load_config(path, CONFIG_CLASSES[system], [f"corpus={corpus}"])
    features = getattr(config, "features", None)
    extractors = features.extractors if features is not None else ()
    hears_wavlm = any(part["kind"] == "wavlm" for part in extractors)
    more = [f"features.weights={wavlm}"] if hears_wavlm else []
    if getattr(config, "unpaired", None) is not None:
        more.append(f"unpaired.corpus={idle}")
    recall = getattr(config, "recall", None)
    if recall is not None:  # the tiny network has 4 levels; the finest is retrieval
        more.append(f"recall.level={4 if recall.level == config.network.levels else 2}")
    run = tmp_path / "run"
    with pytest.raises(SystemExit) as left:
        main(["train", str(path), f"corpus={corpus}", f"out={run}", *TINY[system], *more])
    assert left.value.code == 0
    for name in ("config.yaml", "skeleton.json", "model.safetensors", "README.md"):
        assert (run / "model" / name).is_file(), name
    model = gk.load(run / "model", weights=wavlm if hears_wavlm else None)
    told = {"path": tmp_path / "path.csv"} if getattr(config, "path", False) else {"seconds": 2.0}
    rows = "".join(f"{k / 30:.5f},0,{k / 30:.5f}\n" for k in range(60))
    (tmp_path / "path.csv").write_text(f"time,x,z\n{rows}", encoding="utf-8")
    if system == "diffusion":
        # All the steps of a schedule would take what two updates trained out of this world.
        told["steps"] = 4
    motion = model.generate(**told)
    assert model.fps == config.fps
    assert (motion.fps, motion.n_frames) == (30.0, 60), "as its recordings"
    assert motion.skeleton.n_joints == 19


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_the_first_line_says_how_to_run_it_or_what_it_is_for(path):
    first = path.read_text(encoding="utf-8").splitlines()[0]
    assert first.startswith("# ") and len(first) > 20
    if first.startswith("# gesturekit"):
        program, verb, config, *overrides = shlex.split(first.removeprefix("# "))
        assert (program, verb, config) == (
            "gesturekit",
            "train",
            path.relative_to(ROOT).as_posix(),
        )
        load_config(path, CONFIG_CLASSES[read_chain(path)["system"]], overrides)


@pytest.mark.parametrize("folder", sorted({path.parent for path in CONFIGS}), ids=lambda f: f.name)
def test_every_recipe_has_a_page_that_names_its_configurations(folder):
    page = (folder / "README.md").read_text(encoding="utf-8")
    for path in folder.glob("*.yaml"):
        assert path.name in page, f"{folder.name}/README.md does not say what {path.name} is"


@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_every_script_starts_and_says_what_it_wants(script):
    asked = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True)
    assert asked.returncode == 0, asked.stderr
    assert "usage:" in asked.stdout


def test_fine_tuning_goes_on_from_what_pretraining_made(corpus, idle, tmp_path):
    recipe = ROOT / "recipes" / "diffusion_speech"
    before, after = tmp_path / "before", tmp_path / "after"
    for name, more in (
        ("pretrain", [f"unpaired.corpus={idle}", f"out={before}"]),
        ("finetune", [f"start_from={before / 'model'}", f"out={after}"]),
    ):
        with pytest.raises(SystemExit) as left:
            main(
                ["train", str(recipe / f"{name}.yaml"), f"corpus={corpus}"]
                + [*TINY["diffusion"], *more]
            )
        assert left.value.code == 0, name
    page = (after / "model" / "README.md").read_text(encoding="utf-8")
    assert f"**Began with**: {before / 'model'}" in page
