"""Configurations: inheritance, overrides, and errors that say what to do."""

import json
import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest
import yaml

from gesturekit.diffusion import DiffusionConfig
from gesturekit.errors import ConfigError
from gesturekit.training.config import build, dump_yaml, load_config, to_dict


@dataclass(frozen=True)
class Inner:
    rate: float = 1e-4
    steps: tuple[int, ...] = (1, 2)
    mode: Literal["input", "all"] | tuple[str, ...] = "all"


@dataclass(frozen=True)
class Outer:
    corpus: Path
    window: float | None = 10.0
    name: str = "run"
    inner: Inner = field(default_factory=Inner)


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    return path


def test_a_child_changes_single_values_of_its_parent(tmp_path):
    write(tmp_path, "base.yaml", "corpus: data/c.jsonl\ninner: {rate: 0.1, steps: [3, 4]}")
    child = write(tmp_path, "sub/child.yaml", "base: ../base.yaml\ninner: {rate: 5e-4}")
    config = load_config(child, Outer)
    assert config.inner == Inner(rate=5e-4, steps=(3, 4)), "a number, though it has no dot"
    assert config.corpus == tmp_path / "data/c.jsonl", "relative to the file that names it"


def test_settings_are_python_values_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, "deep/a.yaml", "corpus: c.jsonl\ninner: {rate: 0.5, steps: [1]}")
    settings = {"inner": {"steps": (2, 3)}, "window": None, "corpus": Path("here.jsonl")}
    config = load_config(path, Outer, ["inner.rate=0.2"], settings)
    assert config.inner == Inner(rate=0.2, steps=(2, 3))
    assert (config.window, config.corpus) == (None, tmp_path / "here.jsonl")
    assert load_config(path, Outer, settings={"inner.rate": 1}).inner.rate == 1.0
    with pytest.raises(ConfigError, match=r"(?=.*inner\.rat\b)(?=.*inner\.rate)"):
        load_config(path, Outer, settings={"inner": {"rat": 1}})


def test_a_written_configuration_reads_back_the_same(tmp_path):
    config = load_config(write(tmp_path, "a.yaml", "corpus: c\ninner: {mode: [Hips]}"), Outer)
    assert build(Outer, to_dict(config)) == config
    assert to_dict(config)["inner"] == {"rate": 1e-4, "steps": [1, 2], "mode": ["Hips"]}
    values = {"name": "Jürgen", "at": [1, {"b": None, "a": 2}]}
    text = dump_yaml(values)
    assert yaml.safe_load(text) == values
    assert "Jürgen" in text and text.index("name") < text.index("at"), "as a person wrote them"


@pytest.mark.parametrize(
    ("text", "overrides", "says"),
    [
        ("corpus: c\ninner: {rat: 1}", [], r"inner\.rat\b & inner\.rate"),
        ("corpus: c\nwindow: wide", [], "window & wide"),
        ("corpus: c\ninner: {mode: other}", [], "other & input & all"),
        ("corpus: c\ninner: 3", [], "inner & 3"),
        ("window: 3", [], "corpus"),
        ("corpus: c", ["name=3"], "name & 3 & str"),
        ("corpus: c\ninner: {rate: null}", [], r"inner\.rate"),
        ("corpus: c\nwindow: true", [], "window & True"),
        ("corpus: c\ninner: {steps: 3}", [], r"inner\.steps & 3 & list"),
        ("corpus: c\ninner: {steps: [1.5]}", [], r"inner\.steps & 1\.5"),
        ("corpus: c\nbase: 3", [], "base & 3"),
        ("corpus: c", ["=3"], "=3 & key=value"),
        ("corpus: c", ["window=[1"], r"window=\[1 & YAML"),
        (f"corpus: c\nwindow: {'1' * 41}", [], "41 digits"),
        ("- a list", [], "list"),
        ("corpus: !!python/object/apply:os.getcwd []", [], "python/object/apply"),
        ("base: a.yaml", [], "base"),
        ("base: gone/a.yaml", [], r"gone/a\.yaml"),
        # Neither half a name nor one of two alike is left to guess.
        ("corpus: c\ninner.ratio: 3", [], r"inner\.ratio & inner\.rate"),
        # An error in an override does not blame the file.
        ("corpus: c", ["inner.rate=fast"], "^inner.rate & fast"),
        ("corpus: c\ninner: {rate: fast}", ["corpus=d"], r"a\.yaml & inner\.rate & fast"),
    ],
)
def test_mistakes_are_named(tmp_path, text, overrides, says):
    with pytest.raises(ConfigError) as caught:
        load_config(write(tmp_path, "a.yaml", text), Outer, overrides)
    assert all(re.search(fact, str(caught.value)) for fact in says.split(" & "))
    assert "a.yaml" in str(caught.value) or overrides


@pytest.mark.parametrize(
    ("values", "meant"),
    [
        ({"schedule": {"updates": 3}}, "training.updates"),
        ({"updates": 3}, "training.updates"),
        ({"netwrk": {"blocks": 3}}, "network"),
        ({"epochs": 3}, "training.updates"),
        ({"optim": {"lr": 3}}, "training.learning_rate"),
        ({"training": {"clip_value": 3}}, "training.clip"),
    ],
)
def test_a_setting_of_another_name_is_refused_with_the_right_one(values, meant):
    with pytest.raises(ConfigError, match=re.escape(meant)):
        build(DiffusionConfig, values)


def test_hostile_files_are_refused_before_they_fill_memory(tmp_path):
    long, itself = "corpus: c\nname: " + "x" * (2 << 20), "corpus: &c [*c]"
    for text, fact in ((long, "MiB"), (itself, "corpus")):
        with pytest.raises(ConfigError, match=rf"(?=.*a\.yaml)(?=.*{fact})"):
            load_config(write(tmp_path, "a.yaml", text), Outer)
    few = "corpus: c\ninner: {steps: &s [1, 2]}\nwindow: 40000000000000000000000000000000000000.0"
    assert load_config(write(tmp_path, "a.yaml", few), Outer).window == 4e37
    (tmp_path / "b.yaml").write_bytes(b"corpus: \xff\xfe")
    for wrong in (tmp_path, tmp_path / "none.yaml", tmp_path / "b.yaml"):
        with pytest.raises(ConfigError, match=re.escape(str(wrong))):
            load_config(wrong, Outer)


@pytest.mark.parametrize(
    "value", ["~nobody-here/corpus.jsonl", "\ud800", "a\0b"], ids=["user", "surrogate", "zero"]
)
def test_what_cannot_be_a_path_is_refused_with_its_key(tmp_path, value):
    path = tmp_path / "config.yaml"
    path.write_text(f"corpus: {json.dumps(value)}\n")
    with pytest.raises(ConfigError, match="(?=.*corpus)(?=.*path)"):
        load_config(path, DiffusionConfig)
