"""Every configuration in recipes/ trains for two steps a stage, as recipes/recipes.toml says."""

import runpy
import shlex
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import gesturekit as gk
from gesturekit.corpus import Manifest, prepare
from gesturekit.diffusion import DiffusionConfig
from gesturekit.multires import MultiresConfig
from gesturekit.training.config import load_config, read_chain
from gesturekit.training.recipes import recipe_table, recipes

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = sorted((ROOT / "recipes").glob("*/*.yaml"))
SCRIPTS = sorted(
    path for path in (ROOT / "recipes").glob("*/*.py") if "__main__" in path.read_text("utf-8")
)

TABLE = recipe_table()
CONFIG_CLASSES = {"multires": MultiresConfig, "diffusion": DiffusionConfig}


@pytest.fixture(scope="module")
def wavlm(tmp_path_factory, write_wavlm) -> Path:
    folder = tmp_path_factory.mktemp("wavlm")
    write_wavlm(folder)
    return folder


def labelled(corpus: Path, path: Path, labels: Callable[[int], dict[str, Any]]) -> Path:
    """The same corpus with labels(n) at its n-th recording."""
    items = [replace(item, **labels(number)) for number, item in enumerate(Manifest.load(corpus))]
    Manifest(items).save(path)
    return path


def text(path: Path, content: str) -> Path:
    path.write_text(content, encoding="utf-8")
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


@pytest.mark.parametrize("folder", sorted({path.parent for path in CONFIGS}), ids=lambda f: f.name)
def test_every_recipe_is_in_the_table_and_its_page_names_its_configurations(folder):
    recipe = recipes()[folder.name]
    assert recipe.about and set(recipe.debug) <= {path.stem for path in recipe.configs}
    page = (folder / "README.md").read_text(encoding="utf-8")
    for path in folder.glob("*.yaml"):
        assert path.name in page, f"{folder.name}/README.md does not say what {path.name} is"


def flags_of(path: Path, **places: Path) -> list[str]:
    flags = [*TABLE["debug"][read_chain(path)["system"]]]
    flags += recipes()[path.parent.name].debug.get(path.stem, ())
    for name, place in places.items():
        flags = [flag.replace(name, str(place)) for flag in flags]
    return flags


@pytest.mark.parametrize("path", CONFIGS, ids=name_of)
def test_the_configuration_can_be_read_with_its_debug_settings(path):
    schema = CONFIG_CLASSES[read_chain(path)["system"]]
    for flags in ([], flags_of(path)):
        load_config(path, schema, ["corpus=corpus.jsonl", *flags])


QUICK = ("multires_speech/light.yaml",)  # and fine-tuning by diffusion below


@pytest.mark.parametrize(
    "path",
    [p if name_of(p) in QUICK else pytest.param(p, marks=pytest.mark.stress) for p in CONFIGS],
    ids=name_of,
)
def test_the_recipe_trains_and_its_model_moves(
    path, gesturekit, quick_corpus, request, idle, tmp_path
):
    corpus = quick_corpus
    system = read_chain(path)["system"]
    if "styles" in read_chain(path):
        by_turns = ("calm", "lively")
        corpus = labelled(corpus, tmp_path / "a.jsonl", lambda n: {"style": by_turns[n % 2]})
    if read_chain(path).get("events"):
        events = {"events": text(tmp_path / "a.csv", "time,name\n0.5,kick\n1.0,kick\n")}
        corpus = labelled(corpus, tmp_path / "b.jsonl", lambda _: {"conditions": events})
    config = load_config(path, CONFIG_CLASSES[system], [f"corpus={corpus}"])
    kinds = {part["kind"] for part in config.features.extractors} if config.features else set()
    if "words" in kinds:
        words = {"words": text(tmp_path / "a.tsv", "0.1\t0.4\thello\n0.5\t0.9\tthere\n")}
        corpus = labelled(corpus, tmp_path / "c.jsonl", lambda _: {"conditions": words})
    wavlm = request.getfixturevalue("wavlm") if "wavlm" in kinds else Path()
    flags = flags_of(path, WAVLM=wavlm, IDLE=idle)
    run = tmp_path / "run"
    assert gesturekit("train", name_of(path), f"corpus={corpus}", f"out={run}", *flags).status == 0
    for name in TABLE["makes"]:
        assert (run / name).is_file(), name
    model = gk.load(run / "model", weights=wavlm if "wavlm" in kinds else None)
    told = {"path": tmp_path / "path.csv"} if getattr(config, "path", False) else {"seconds": 2.0}
    rows = "".join(f"{k / 30:.5f},0,{k / 30:.5f}\n" for k in range(60))
    text(tmp_path / "path.csv", f"time,x,z\n{rows}")
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
        assert (program, verb, config) == ("gesturekit", "train", path.relative_to(ROOT).as_posix())
        load_config(path, CONFIG_CLASSES[read_chain(path)["system"]], overrides)


def modules_of_recipes() -> list[str]:
    """Names of the imported modules that lie beside a script, which several recipes share."""
    return [
        name
        for name, module in sys.modules.items()
        if str(ROOT / "recipes") in (getattr(module, "__file__", None) or "")
    ]


@pytest.mark.parametrize("script", SCRIPTS, ids=name_of)
def test_every_script_starts_and_says_what_it_wants(script, monkeypatch, capsys):
    """In this process: a new one would import torch for every script."""
    for name in modules_of_recipes():
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.syspath_prepend(script.parent)
    monkeypatch.setattr(sys, "argv", [str(script), "--help"])
    with pytest.raises(SystemExit) as left:
        runpy.run_path(str(script), run_name="__main__")
    for name in modules_of_recipes():
        del sys.modules[name]
    assert left.value.code in (0, None)
    assert "usage:" in capsys.readouterr().out


def test_fine_tuning_goes_on_from_what_pretraining_made(gesturekit, quick_corpus, idle, tmp_path):
    recipe = ROOT / "recipes" / "diffusion_speech"
    before, after = tmp_path / "before", tmp_path / "after"
    for name, more in (
        ("pretrain", [f"unpaired.corpus={idle}", f"out={before}"]),
        ("finetune", [f"start_from={before / 'model'}", f"out={after}"]),
    ):
        flags = (f"corpus={quick_corpus}", "noise.steps=8", *TABLE["debug"]["diffusion"], *more)
        assert gesturekit("train", recipe / f"{name}.yaml", *flags).status == 0, name
    page = (after / "model" / "README.md").read_text(encoding="utf-8")
    assert str(before / "model") in page
    assert gk.load(after / "model").generate(seconds=1.0, steps=4).n_frames == 30
