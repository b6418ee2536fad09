"""Recipes by name: listed, copied, trained from anywhere."""

from pathlib import Path

import pytest

from gesturekit.errors import ConfigError
from gesturekit.training.config import read_chain
from gesturekit.training.recipes import find_config, recipe_config

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch) -> None:
    """A folder without recipes, as after pip install."""
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("multires_speech", "multires_speech/config.yaml"),
        ("multires_speech/no_state", "multires_speech/no_state.yaml"),
        ("recipes/multires_speech/light.yaml", "multires_speech/light.yaml"),
        ("path_100style", "path_100style/config.yaml"),
    ],
)
def test_a_name_denotes_a_configuration(name, file):
    assert find_config(name) == ROOT / "recipes" / file


@pytest.mark.parametrize(
    "name", ["../recipes/ganimator", "ganimator/../ganimator", "/etc", ".", ""]
)
def test_a_name_does_not_leave_the_folder_of_recipes(name):
    assert recipe_config("ganimator") is not None
    assert recipe_config(name) is None


def test_a_file_of_the_user_takes_precedence(tmp_path):
    own = tmp_path / "recipes" / "multires_speech" / "light.yaml"
    own.parent.mkdir(parents=True)
    own.write_text("system: multires\n")
    assert find_config("recipes/multires_speech/light.yaml").resolve() == own


def test_the_list_names_recipes_and_configurations(gesturekit):
    listed = gesturekit("recipes")
    folders = {path.parent.name for path in ROOT.glob("recipes/*/config.yaml")}
    assert {line.split()[0] for line in listed.out.splitlines()} == folders
    one = gesturekit("recipes", "ls", "experts").out
    assert "gesturekit train experts corpus=" in one
    assert "gesturekit train experts/single corpus=" in one and "moves_like" in one


def test_a_copy_can_be_edited_and_is_trained_by_its_folder(gesturekit, tmp_path):
    """Parents in other recipes are found from the copy too."""
    done = gesturekit("recipes", "cp", "diffusion_styles", "new/folder/my styles")
    assert done.status == 0 and "gesturekit train" in done.out
    copy = tmp_path / "new" / "folder" / "my styles"
    files = (ROOT / "recipes" / "diffusion_styles").glob("*.*")
    assert {path.name for path in copy.iterdir()} == {path.name for path in files}
    text = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(text.replace("updates: 4000", "updates: 7"))
    shown = gesturekit("train", copy, "--show").out
    assert "training.updates=7" in shown and "network.architecture=diffwave" in shown


def test_a_copy_begins_anew_where_one_was_interrupted(gesturekit, tmp_path):
    (tmp_path / ".ganimator.partial").mkdir()
    (tmp_path / ".ganimator.partial" / "half.yaml").touch()
    gesturekit("recipes", "cp", "ganimator").ok()
    assert not (tmp_path / "ganimator" / "half.yaml").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["ganimator"]


def test_a_copy_replaces_nothing(gesturekit, tmp_path):
    assert gesturekit("recipes", "cp", "ganimator").status == 0
    (tmp_path / "ganimator" / "config.yaml").write_text("mine")
    gesturekit("recipes", "cp", "ganimator").fails(2, "ganimator")
    assert (tmp_path / "ganimator" / "config.yaml").read_text() == "mine"


def test_usage_errors(gesturekit):
    gesturekit("recipes", "cp", "own_corpse").fails(2, "own_corpus")
    gesturekit("recipes", "ls", "demo", "there").fails(2, "ls", "one")


def test_base_names_a_recipe_or_the_nearest_file(tmp_path):
    (tmp_path / "mine.yaml").write_text("base: multires_speech/light\nfps: 30\n")
    chain = read_chain(tmp_path / "mine.yaml")
    assert (chain["fps"], chain["system"]) == (30, "multires") and chain["state"]
    (tmp_path / "mine.yaml").write_text("base: multires_speech/lite\n")
    with pytest.raises(ConfigError, match="multires_speech/lite"):
        read_chain(tmp_path / "mine.yaml")
