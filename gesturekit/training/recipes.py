"""Recipes: the configurations that come with gesturekit, found by name."""

from __future__ import annotations

import difflib
import shutil
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from gesturekit.errors import ConfigError
from gesturekit.wording import did_you_mean

_PACKAGE = Path(__file__).resolve().parents[1]
# In an installed package, and in a checkout.
_PLACES = (_PACKAGE / "recipes", _PACKAGE.parent / "recipes")
_TABLE = "recipes.toml"


@dataclass(frozen=True)
class Recipe:
    """One recipe, as `recipes/recipes.toml` describes it.

    Attributes:
        name: name of its folder.
        about: one line for the list of recipes.
        debug: settings, by configuration, with which it trains for two steps, beside those of its
            system.
    """

    name: str
    about: str
    debug: Mapping[str, Sequence[str]]

    @property
    def folder(self) -> Path:
        """Folder of the recipe."""
        return recipes_folder() / self.name

    @property
    def configs(self) -> list[Path]:
        """Configuration files of the recipe, config.yaml first."""
        files = self.folder.glob("*.yaml")
        return sorted(files, key=lambda path: (path.name != "config.yaml", path))


def recipes_folder() -> Path:
    """Return the folder of the recipes that come with gesturekit.

    Raises:
        ConfigError: this installation has none.
    """
    for folder in _PLACES:
        if (folder / _TABLE).is_file():
            return folder
    raise ConfigError(f"{_PLACES[0]}: the recipes are missing; install gesturekit again")


def recipe_table() -> dict[str, Any]:
    """Return `recipes/recipes.toml`: what a training makes, debug settings, recipes."""
    with (recipes_folder() / _TABLE).open("rb") as file:
        return tomllib.load(file)


def recipes() -> dict[str, Recipe]:
    """Return the recipes that come with gesturekit, by name, in the order of their table."""
    rows = recipe_table()["recipe"]
    return {name: Recipe(name, row["about"], row.get("debug", {})) for name, row in rows.items()}


def recipe(name: str) -> Recipe:
    """Return the recipe of a name.

    Raises:
        ConfigError: there is none; the message suggests the nearest.
    """
    known = recipes()
    if name not in known:
        hint = did_you_mean(name, known) or f"it is one of {', '.join(known)}"
        raise ConfigError(f"{name!r} is not a recipe; {hint}")
    return known[name]


def recipe_config(name: str | Path) -> Path | None:
    """Return the configuration that a name denotes, or None.

    `NAME` is the recipe's config.yaml, `NAME/VARIANT` another configuration of it; `.yaml` and a
    leading `recipes/` may be given too.
    """
    parts = Path(name).parts
    if parts[:1] == ("recipes",):
        parts = parts[1:]
    # Letters, digits and _ only, so that a name cannot leave the folder.
    words = [part.removesuffix(".yaml").replace("_", "a") for part in parts]
    if not 1 <= len(parts) <= 2 or not all(word.isalnum() for word in words):
        return None
    variant = parts[1] if len(parts) == 2 else "config"
    path = recipes_folder() / parts[0] / f"{variant.removesuffix('.yaml')}.yaml"
    return path if path.is_file() else None


def named_config(path: Path) -> Path | None:
    """Return the configuration in the copy of a recipe, or of a recipe by its name; else None.

    Files, and folders with a config.yaml, take precedence over recipes that come with gesturekit;
    a folder of data named `zeggs` does not.
    """
    if is_copy(path):
        return path / "config.yaml"
    if path.is_file() or (path / "config.yaml").is_file():
        return None
    return recipe_config(path)


def find_config(path: Path | str) -> Path:
    """Return the configuration file that a path, the copy of a recipe, or a name denotes.

    Raises:
        ConfigError: there is none; the message suggests the nearest.
    """
    file = named_config(Path(path)) or Path(path)
    if file.exists():
        return file
    beside = [str(other) for other in file.parent.glob("*.yaml")] if file.parent.is_dir() else []
    known = {name: name for name in [*beside, *_config_names()]}
    # A recipe may be meant by its folder's name, as in `recipes/multires_speech`.
    known |= {str(Path(name).parent): name for name in known if Path(name).name == "config.yaml"}
    same = [name for name in known if Path(name).name == file.name]
    # A file of the user's rather than one that comes with gesturekit.
    meant = [name for name in same if Path(name).is_file()][:3] or same[:3]
    meant = meant or [known[name] for name in difflib.get_close_matches(str(file), known, n=1)]
    hint = f"there are {', '.join(main_configs())} (gesturekit recipes ls)"
    if meant:
        hint = f"did you mean {' or '.join(meant)}?"
    raise ConfigError(f"{path}: no such configuration file; {hint}")


def copy_recipe(name: str, destination: Path) -> Path:
    """Copy a recipe's folder, and return the copy.

    Args:
        name: name of the recipe.
        destination: folder that does not exist yet; its parent is created if needed. Parents
            (`base:`) in other recipes stay there and are found by name.

    Raises:
        ConfigError: there is no such recipe, or the destination exists.
    """
    folder = recipe(name).folder
    if destination.exists():
        raise ConfigError(f"{destination}: exists already; name another folder for the copy")
    destination.parent.mkdir(parents=True, exist_ok=True)
    beside = destination.with_name(f".{destination.name}.partial")
    shutil.rmtree(beside, ignore_errors=True)  # of a copy that was interrupted
    shutil.copytree(folder, beside, ignore=shutil.ignore_patterns("__pycache__"))
    beside.rename(destination)
    return destination


def main_configs() -> list[str]:
    """Return the main configuration of each recipe, without its variants."""
    return [name for name in _config_names() if Path(name).name == "config.yaml"]


def is_copy(folder: Path) -> bool:
    """Return whether a folder holds a recipe: a config.yaml that is neither a run nor a model."""
    others = ("versions.json", "model.safetensors", "checkpoints")
    has_config = (folder / "config.yaml").is_file() and (folder / "README.md").is_file()
    return has_config and not any((folder / name).exists() for name in others)


def _config_names() -> list[str]:
    """Return `recipes/NAME/VARIANT.yaml` for each configuration here and in gesturekit."""
    folders: Sequence[Path] = (Path(), recipes_folder().parent)
    files = {path.relative_to(f) for f in folders for path in f.glob("recipes/*/*.yaml")}
    return sorted(path.as_posix() for path in files)
