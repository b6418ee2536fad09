"""Every configuration in recipes/ trains for two steps a pair, through the command line."""

from __future__ import annotations

import shlex
from dataclasses import replace
from pathlib import Path

import pytest

import gesturekit as gk
from gesturekit.cli import main
from gesturekit.corpus import Manifest
from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import load_config, read_chain

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "recipes").glob("*/*.yaml"))

# What makes a recipe of each system a matter of a second. What a recipe is about (features, losses,
# steps, FiLM, joints) stays as it is.
TINY = {
    "multires": (
        "threads=1",
        "network.levels=4",
        "network.channels=[2,2]",
        "network.embedding=4",
        "schedule.first_pair=2",
        "schedule.further_pairs=2",
        "schedule.batch=2",
        "schedule.window=2",
        "schedule.bank=2",
    )
}
CONFIG_CLASSES = {"multires": MultiresConfig}


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


def name_of(path: Path) -> str:
    return path.relative_to(ROOT / "recipes").as_posix()


def test_there_are_recipes():
    assert {"demo/config.yaml", "multires_speech/config.yaml", "multires_speech/light.yaml"} <= {
        name_of(path) for path in CONFIGS
    }


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_the_recipe_trains_and_its_model_moves(path, corpus, wavlm, tmp_path):
    system = read_chain(path)["system"]
    if "styles" in read_chain(path):
        corpus = with_styles(corpus, tmp_path / "styles.jsonl")
    config = load_config(path, CONFIG_CLASSES[system], [f"corpus={corpus}"])
    extractors = config.features.extractors if config.features is not None else ()
    hears_wavlm = any(part["kind"] == "wavlm" for part in extractors)
    weights = [f"features.weights={wavlm}"] if hears_wavlm else []
    run = tmp_path / "run"
    with pytest.raises(SystemExit) as left:
        main(["train", str(path), f"corpus={corpus}", f"out={run}", *TINY[system], *weights])
    assert left.value.code == 0
    for name in ("config.yaml", "skeleton.json", "model.safetensors", "README.md"):
        assert (run / "model" / name).is_file(), name
    model = gk.load(run / "model", weights=wavlm if hears_wavlm else None)
    motion = model.generate(seconds=2.0)
    assert motion.fps == config.fps and motion.n_frames == 2 * config.fps
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
