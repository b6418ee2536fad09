"""Registry of the systems; the only place that imports a system by name."""

from __future__ import annotations

import importlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from gesturekit.errors import ConfigError, ModelError, gesturekit_errors
from gesturekit.field_docs import field_docs
from gesturekit.model import Controls, Model, control_entries
from gesturekit.training.config import (
    Setting,
    list_settings,
    load_config,
    read_chain,
    read_yaml,
    to_dict,
)
from gesturekit.training.recipes import find_config, main_configs, named_config
from gesturekit.training.run_config import RunConfig
from gesturekit.training.run_folder import Run, has_no_run, unfinished

if TYPE_CHECKING:
    from audio_features.weight_files import WeightPlaces

log = logging.getLogger(__name__)


SYSTEMS = {
    "multires": {
        "model": "gesturekit.multires.model:MultiresModel",
        "controls": "gesturekit.multires.controls:MultiresControls",
        "config": "gesturekit.multires.config:MultiresConfig",
        "trainer": "gesturekit.multires.training.trainer:Trainer",
        "fit_live": "gesturekit.multires.training.result:fit_live",
    },
    "diffusion": {
        "model": "gesturekit.diffusion.model:DiffusionModel",
        "controls": "gesturekit.diffusion.controls:DiffusionControls",
        "config": "gesturekit.diffusion.config:DiffusionConfig",
        "trainer": "gesturekit.diffusion.training.trainer:Trainer",
    },
}
"""Parts of the systems as `module:name`, imported on first use; `fit_live` of those that stream."""

_BUNDLED = Path(__file__).parent / "models"


def bundled_models() -> list[str]:
    """Return the names of the models that come with the package."""
    if not _BUNDLED.is_dir():
        return []
    return sorted(folder.parent.name for folder in _BUNDLED.glob("*/config.yaml"))


def bundled_speech() -> Path:
    """Return the short speech recording that comes with the demo model."""
    return _BUNDLED / "demo" / "speech.wav"


def drawing_options(model: Model) -> dict[str, str]:
    """Return options of pages, pictures and videos of a model's motion: bundled ones are human."""
    is_bundled = model.folder is not None and model.folder.parent == _BUNDLED
    return {"body": "human"} if is_bundled else {}


def model_folder(model: str | Path) -> Path:
    """Return the folder of a model, given by a bundled name or a path.

    A bundled name takes precedence over a folder of the same name; ./demo is the folder.
    """
    return _BUNDLED / str(model) if str(model) in bundled_models() else Path(model)


def controls_type(kind: str) -> type[Controls]:
    """Return the controls of a system, as the keywords of its `generate`."""
    return _part(kind, "controls")


def control_docs() -> dict[str, str]:
    """Return the docstring of each control of any system, with its default."""
    docs, entries = field_docs(Controls), control_entries(Controls)
    for schema in map(controls_type, SYSTEMS):
        docs |= field_docs(schema)
        entries |= control_entries(schema)
    for name, entry in entries.items():
        if isinstance(entry.default, bool):
            docs[name] += f"  [default: {'on' if entry.default else 'off'}]"
        elif isinstance(entry.default, int | float):
            docs[name] += f"  [default: {entry.default:g}]"
    return docs


@gesturekit_errors()
def fit_live(model: str | Path, corpus: str | Path) -> None:
    """Add the predictions for live speech to a model folder, from the corpus of its training.

    Raises:
        ModelError: there is no such folder, or the model cannot stream.
        CorpusError, AudioError, FormatError: a file cannot be read.
    """
    loaded = load(model)
    if "fit_live" not in SYSTEMS[loaded.kind]:
        raise ModelError(f"{model}: a {loaded.kind} model cannot stream")
    _part(loaded.kind, "fit_live")(loaded, Path(corpus))


@gesturekit_errors()
def load(
    model: str | Path,
    *,
    weights: WeightPlaces | None = None,
    device: str = "cpu",
    dtype: Literal["fp32", "bf16"] = "fp32",
) -> Model:
    """Load a model.

    Args:
        model: a bundled name such as "demo", a model folder, or a run folder with a model.
        weights: folder of WavLM weights or of a Hugging Face encoder, for models with such
            features; for several encoders {kind: folder}, such as {"wavlm": "wavlm-base-plus/",
            "words": "bert-base/"}; the kinds are wavlm, hf and words.
        device: device of the networks: cpu, cuda, cuda:1, or auto (a GPU if there is one).
            Multires networks stay on the CPU, where they generate in milliseconds.
        dtype: precision of the network. With bf16, diffusion is 1.5 to 1.9 times as fast on
            processors that support it, and its motion differs slightly.

    Returns:
        a model, whose `generate` returns motion.

    Raises:
        ModelError: there is no such model, it cannot be read, or it does not support the dtype.
        ConfigError: there is no such device.
        WeightsError: weights are missing, or differ from those of training.

    Examples:
        >>> motion = gk.load("demo").generate(seconds=2)
        >>> motion.n_frames, motion.fps
        (60, 30.0)
    """
    folder = model_folder(model)
    if not _is_model(folder) and _is_model(folder / "model"):
        folder /= "model"  # the model of a run folder
    kind = None
    try:
        kind = read_yaml(folder / "config.yaml").get("kind")
        problem = f"{folder / 'config.yaml'}: kind {kind!r}; known: {', '.join(SYSTEMS)}. "
        problem += "A newer kind needs a newer gesturekit"
    except ConfigError as error:
        known = ", ".join(bundled_models()) or "none is bundled"
        problem = f"{model}: neither a model folder nor a bundled model ({known})"
        if folder.is_dir():
            problem = f"not a model folder: {error}"
        elif folder.suffix.lower() in (".bvh", ".npz", ".glb", ".fbx"):
            problem = f"{model}: a motion, not a model: gesturekit.Motion.load reads it"
    if kind not in [*SYSTEMS]:
        raise ModelError(unfinished(folder) or problem)
    return _part(kind, "model").load(folder, weights=weights, device=device, dtype=dtype)


@gesturekit_errors()
def train(
    config: str | Path,
    overrides: Sequence[str] | Mapping[str, Any] = (),
    *,
    resume: bool = False,
    **settings: Any,
) -> Path:
    """Train a model as a configuration file describes.

    `train("light.yaml", {"training.batch": 8}, corpus="corpus.jsonl", out="runs/mine")`.

    Args:
        config: YAML file, whose `system:` (or its parent's) is one of `SYSTEMS`, or the name of a
            recipe (`multires_speech/light`). To resume, the run folder is enough.
        overrides: single settings, as `key=value` strings, or by dotted name.
        resume: continue from the last checkpoint of the run folder; a run that was stopped before
            it had a folder begins, and a finished one stays as it is.
        settings: further settings by name; a mapping changes single settings of a section.

    Returns:
        the model folder.

    Raises:
        ConfigError: the configuration is wrong.

    Examples:
        Every setting is checked before anything is read:

        >>> try:
        ...     gk.train("multires_speech/light", {"training.batch": 0})
        ... except gk.GestureKitError as error:
        ...     print("training.batch" in str(error))
        True
    """
    if isinstance(overrides, Mapping):
        settings, overrides = {**overrides, **settings}, ()
    kind, loaded = _resolve(config, overrides, settings, resume=resume)
    if resume and _is_model(model := loaded.out / "model"):
        Run(loaded.out, to_dict(loaded), resume=True)  # refuses other settings
        longer = f"gesturekit train {loaded.out}/config.yaml longer={2 * loaded.longer:g} out=OTHER"
        log.info("%s: finished; nothing to resume. To train longer: %s", loaded.out, longer)
        return model
    if resume and has_no_run(loaded.out):
        log.info("%s: no run to resume yet; starting a new one.", loaded.out)
        resume = False
    from gesturekit.training.trainer import run_training  # imports torch

    return run_training(_part(kind, "trainer"), loaded, resume=resume)


def plan_training(config: str | Path, overrides: Sequence[str] = ()) -> None:
    """Log the data, output folder and estimated duration of a training, without training.

    Raises:
        ConfigError: the configuration is wrong. A run folder that is in use is only a warning.
    """
    from gesturekit.training import trainer

    kind, loaded = _resolve(config, overrides, {}, resume=False)
    trainer.plan_training(_part(kind, "trainer"), loaded)


def make_arrays(config: str | Path, overrides: Sequence[str] = ()) -> None:
    """Make the arrays of a long corpus, which a training with these settings then reads.

    Raises:
        ConfigError: the configuration is wrong.
        CorpusError: the corpus cannot be trained on.
        OutputError: the disk is full; the arrays made so far are kept.
    """
    from gesturekit.training import trainer

    kind, loaded = _resolve(config, overrides, {}, resume=False)
    trainer.make_arrays(_part(kind, "trainer"), loaded)


def resolved_settings(config: str | Path, overrides: Sequence[str] = ()) -> list[Setting]:
    """Return all settings that `train` would use.

    The corpus need not exist; where none is given, its value is null.

    Args:
        config: YAML file, or a run folder.
        overrides: single settings, as `key=value` strings.

    Raises:
        ConfigError: the configuration is wrong.
    """
    path = Path(config)
    resume = path.is_dir()
    file, _ = _config_file(path, overrides, resume=resume)
    has_corpus = "corpus" in read_chain(file) or any(o.startswith("corpus=") for o in overrides)
    missing = {} if has_corpus else {"corpus": "corpus.jsonl"}
    _, loaded = _resolve(config, overrides, missing, resume=resume)
    if not has_corpus:
        loaded = replace(loaded, corpus=None)  # type: ignore[arg-type]  # shown as null
    return list(list_settings(loaded))


def _resolve(
    config: str | Path, overrides: Sequence[str], settings: Mapping[str, Any], *, resume: bool
) -> tuple[str, RunConfig]:
    """Return the system that a configuration names, and its settings."""
    path, overrides = _config_file(Path(config), overrides, resume=resume)
    name = _system_name(path, overrides)
    return name, load_config(path, _part(name, "config"), overrides, settings)


def _config_file(
    path: Path, overrides: Sequence[str], *, resume: bool
) -> tuple[Path, Sequence[str]]:
    """Return the configuration file of a path, and the overrides with the folder of a run.

    Raises:
        ConfigError: there is none, or a run folder is given without `resume`.
    """
    path = named_config(path) or path
    if resume and not path.exists():
        problem = "no such run; a training that was interrupted before its first step left none: "
        problem += "begin it again"
    elif path.is_dir():
        if _is_model(path) and (path.parent / "config.yaml").is_file():
            path = path.parent  # the run of a model folder
        problem = "a run folder; add --resume to continue it"
        if not (path / "config.yaml").is_file():
            problem = "a folder without config.yaml, so no run to resume; to train on what is in "
            problem += "it, run gesturekit prepare on it and give a configuration (.yaml)"
        elif resume:
            # Its own config.yaml holds every setting, and the folder may have been moved.
            return path / "config.yaml", [*overrides, f"out={json.dumps(str(path))}"]
    else:
        path = find_config(path)
        suffix = path.suffix.lower()
        if suffix in (".yaml", ".yml"):
            return path, overrides
        problem = f"not a configuration, which is a .yaml file such as {', '.join(main_configs())}"
        if suffix == ".jsonl":
            problem = f"a manifest, not a configuration; gesturekit train own_corpus corpus={path}"
        elif suffix in (".bvh", ".npz", ".wav"):
            problem = "a recording, not a configuration; run gesturekit prepare on its folder, "
            problem += "then gesturekit train own_corpus"
    raise ConfigError(f"{path}: {problem}")


def _system_name(path: Path, overrides: Sequence[str]) -> str:
    """Return the name of the system of a configuration file.

    Raises:
        ConfigError: there is no such system, or the overrides name another than the file.
    """
    name = read_chain(path).get("system")
    given = dict(override.split("=", 1) for override in overrides if "=" in override)
    wanted = given.get("system", name)
    if wanted == name and name in [*SYSTEMS]:
        return str(name)
    problem = f"system: {wanted!r} is not one of {', '.join(SYSTEMS)}"
    if wanted in [*SYSTEMS]:
        same = [n for n in main_configs() if read_chain(find_config(n)).get("system") == wanted]
        problem = f"has the settings of {name!r}; for {wanted!r} take one of its recipes: "
        problem += ", ".join(same)
    raise ConfigError(f"{path}: {problem}")


def _is_model(folder: Path) -> bool:
    """Return whether a folder holds a model: a config.yaml that names its kind."""
    try:
        return "kind" in read_yaml(folder / "config.yaml")
    except ConfigError:
        return False


def _part(kind: str, part: str) -> Any:
    """Import a part of a system."""
    module, _, name = SYSTEMS[kind][part].partition(":")
    return getattr(importlib.import_module(module), name)
