"""Recipes for public corpora, from a tiny folder in the published shape to a model."""

import re

import published
import pytest

from gesturekit.training.config import read_chain
from gesturekit.training.recipes import find_config, recipe_table, recipes

CORPORA = {
    "beat2": ("beat2", published.beat2),
    "zeggs": ("zeggs", published.zeggs),
    "genea2023": ("genea2023", published.genea2023),
    "dance_motorica": ("motorica", published.motorica),
    "path_100style": ("100style", published.style100),
    "gestures_trinity": ("trinity", published.trinity),
}


@pytest.mark.parametrize(
    ("recipe", "how"),
    [
        *((recipe, ("--plan",)) for recipe in ("beat2", "genea2023")),
        *(pytest.param(recipe, (), marks=pytest.mark.stress) for recipe in CORPORA),
    ],
)
def test_from_the_published_folder_to_a_model(
    recipe, how, gesturekit, gesture, write_speech, tmp_path, caplog
):
    layout, make = CORPORA[recipe]

    def write_bvh(path, seconds, fps=30.0, seed=0):
        gesture(seconds, fps, seed=seed).save(path)

    make(tmp_path / "published", write_bvh, write_speech, seconds=2.5)
    corpus = tmp_path / "corpus.jsonl"
    # 1 where something is left out, such as the other gaits of 100STYLE.
    prepare = ("prepare", tmp_path / "published", "--layout", layout, "--holdout", 0)
    assert gesturekit(*prepare, "--out", corpus).status in (0, 1)
    system = read_chain(find_config(recipe))["system"]
    flags = [*recipe_table()["debug"][system], *recipes()[recipe].debug.get("config", ())]
    train = ("train", recipe, f"corpus={corpus}", f"out={tmp_path / 'run'}", *flags, *how)
    caplog.set_level("INFO")
    gesturekit(*train).ok()
    assert (tmp_path / "run" / "model" / "model.safetensors").is_file() == (not how)
    assert re.search(r"\b[1-9]\d* recording", caplog.text)


def test_no_recipe_for_100style_mirrors_what_tells_left_from_right(
    gesturekit, gesture, tmp_path, caplog
):
    caplog.set_level("INFO")
    for style in ("LeftHop", "Old"):
        gesture(4.0, 30.0).save(tmp_path / "walks" / f"{style}.bvh")
    corpus = tmp_path / "corpus.jsonl"
    names = ("--style-pattern", "(?P<style>.+)", "--holdout", 0, "--out", corpus)
    assert gesturekit("prepare", "--unpaired-motion", tmp_path / "walks", *names).status == 0
    flags = recipe_table()["debug"]["diffusion"]
    for recipe in ("path_100style", "path_100style/small", "diffusion_speech/locomotion"):
        caplog.clear()
        run = f"out={tmp_path / 'run'}"
        gesturekit("train", recipe, f"corpus={corpus}", run, "--plan", *flags).ok()
        assert re.search(r"\b3 seq", caplog.text), recipe
