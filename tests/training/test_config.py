"""Configurations: inheritance, overrides, and errors that say what to do."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import pytest

from gesturekit.diffusion.config import DiffusionConfig
from gesturekit.errors import ConfigError
from gesturekit.multires.config import MultiresConfig
from gesturekit.training.config import build, dump_yaml, load_config, read_yaml, to_dict


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


def test_overrides_win_and_their_paths_are_relative_to_the_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, "deep/a.yaml", "corpus: c.jsonl")
    config = load_config(path, Outer, ["inner.rate=1e-3", "window=null", "corpus=here.jsonl"])
    assert (config.inner.rate, config.window) == (1e-3, None)
    assert config.corpus == tmp_path / "here.jsonl"


def test_settings_are_python_values_by_name(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, "deep/a.yaml", "corpus: c.jsonl\ninner: {rate: 0.5, steps: [1]}")
    settings = {"inner": {"steps": (2, 3)}, "window": None, "corpus": Path("here.jsonl")}
    config = load_config(path, Outer, ["inner.rate=0.2"], settings)
    assert config.inner == Inner(rate=0.2, steps=(2, 3))
    assert (config.window, config.corpus) == (None, tmp_path / "here.jsonl")
    assert load_config(path, Outer, settings={"inner.rate": 1}).inner.rate == 1.0
    with pytest.raises(ConfigError, match="unknown key inner.rat; did you mean inner.rate"):
        load_config(path, Outer, settings={"inner": {"rat": 1}})


def test_a_written_configuration_reads_back_the_same(tmp_path):
    config = load_config(write(tmp_path, "a.yaml", "corpus: c\ninner: {mode: [Hips]}"), Outer)
    assert build(Outer, to_dict(config)) == config
    assert to_dict(config)["inner"] == {"rate": 1e-4, "steps": [1, 2], "mode": ["Hips"]}
    assert dump_yaml({"name": "Jürgen", "at": [1, {"b": None, "a": 2}]}) == (
        "name: Jürgen\nat:\n- 1\n- b: null\n  a: 2\n"
    )


@pytest.mark.parametrize(
    ("text", "overrides", "says"),
    [
        ("corpus: c\ninner: {rat: 1}", [], "did you mean inner.rate"),
        ("corpus: c\nwindow: wide", [], "window: 'wide' is not of type float"),
        ("corpus: c\ninner: {mode: other}", [], "'input', 'all'"),
        ("corpus: c\ninner: 3", [], "inner"),
        ("window: 3", [], "corpus is missing"),
        ("corpus: c", ["window"], "key=value"),
        ("corpus: c", ["name=3"], "name: 3 is not of type str"),
        ("corpus: c\ninner: {rate: null}", [], "inner.rate may not be empty"),
        ("corpus: c\nwindow: true", [], "window: True is not of type float"),
        ("corpus: c\ninner: {steps: 3}", [], "inner.steps: 3 is not a list"),
        ("corpus: c\ninner: {steps: [1.5]}", [], r"inner.steps\[\]: 1.5 is not of type int"),
        ("corpus: c\ninner: {steps: [true]}", [], r"inner.steps\[\]: True is not of type int"),
        ("corpus: c\nwholly: 1", [], "unknown key wholly; known: corpus, window, name, inner"),
        ("corpus: c\nbase: 3", [], "base: 3 is not a file name"),
        ("corpus: c", ["=3"], "key=value"),
        ("corpus: c", ["window=[1"], "the value is not valid YAML"),
        (f"corpus: c\nwindow: {'1' * 41}", [], "a number of 41 digits"),
        (f"corpus: c\nname: {'1' * 40}", [], "name: 1{40} is not of type str"),
        ("- a list", [], "expected key: value lines"),
        ("corpus: [unclosed", [], "not valid YAML"),
        ("corpus: !!python/object/apply:os.getcwd []", [], "not valid YAML"),
        ("base: a.yaml", [], "include itself"),
        ("base: gone/a.yaml", [], r"gone/a\.yaml: no such configuration file"),
        ("corpus: c\n3: 4", [], "unknown key 3; known: corpus"),
        ("corpus: c\ninner: {stps: [3]}", [], r"did you mean inner\.steps\?$"),
        # Neither half a name nor one of two alike is left to guess.
        ("corpus: c\ninner.ratio: 3", [], r"unknown key inner\.ratio; did you mean inner\.rate\?$"),
        ("corpus: c\nnames: 3", [], "unknown key names; did you mean name\\?$"),
        # An error in an override does not blame the file.
        ("corpus: c", ["inner.rat=1"], "^unknown key inner.rat"),
        ("corpus: c", ["inner.rate=fast"], "^inner.rate: 'fast'"),
        ("corpus: c", ["iner.rate=1"], "^unknown key iner"),
        ("corpus: c\ninner: {rate: fast}", ["corpus=d"], r"a\.yaml: inner\.rate: 'fast'"),
        ("corpus: c", ["corpus=d", "inner.rate=fast"], "^inner.rate: 'fast'"),
    ],
)
def test_mistakes_are_named(tmp_path, text, overrides, says):
    with pytest.raises(ConfigError, match="(?s)" + says.replace("(", r"\(")) as caught:
        load_config(write(tmp_path, "a.yaml", text), Outer, overrides)
    assert "a.yaml" in str(caught.value) or overrides


def test_a_setting_in_the_wrong_section_is_refused_with_the_right_one(tmp_path):
    for values in ({"schedule": {"updates": 3}}, {"updates": 3}, {"network": {"updates": 3}}):
        with pytest.raises(ConfigError, match=r"did you mean training\.updates\?"):
            build(DiffusionConfig, values)
    with pytest.raises(ConfigError, match=r"unknown key netwrk; did you mean network\?"):
        build(DiffusionConfig, {"netwrk": {"blocks": 3}})
    # Both network.levels and recall.level are settings.
    with pytest.raises(ConfigError, match=r"key network\.level; did you mean network\.levels\?$"):
        build(MultiresConfig, {"network": {"level": 3}})
    for name in ("steps", "epochs", "training.iterations"):
        with pytest.raises(ConfigError, match=r"did you mean longer or training\.updates\?$"):
            load_config(write(tmp_path, "a.yaml", f"{name}: 9"), DiffusionConfig)
    with pytest.raises(ConfigError, match=r"unknown key optim\.lr; .* training\.learning_rate\?$"):
        build(DiffusionConfig, {"optim": {"lr": 3}})
    # Below 0.6, the usual least likeness: 8 of 14 letters of both names are the same.
    with pytest.raises(ConfigError, match=r"did you mean training\.clip\?$"):
        build(DiffusionConfig, {"training": {"clip_value": 3}})


def test_a_file_may_have_the_dotted_keys_of_the_command_line(tmp_path):
    write(tmp_path, "base.yaml", "corpus: c\ninner: {rate: 0.1, steps: [3]}")
    text = "base: base.yaml\ninner.rate: 0.2\ninner: {mode: input}"
    config = load_config(write(tmp_path, "a.yaml", text), Outer)
    assert config.inner == Inner(rate=0.2, steps=(3,), mode="input")


def test_eight_parents_are_read_and_nine_are_too_many(tmp_path):
    write(tmp_path, "0.yaml", "corpus: c\nname: first")
    for k in range(1, 10):
        write(tmp_path, f"{k}.yaml", f"base: {k - 1}.yaml\nwindow: {k}")
    config = load_config(tmp_path / "8.yaml", Outer)
    assert (config.name, config.window) == ("first", 8.0)
    with pytest.raises(ConfigError, match="too many nested base files"):
        load_config(tmp_path / "9.yaml", Outer)


def test_hostile_files_are_refused_before_they_fill_memory(tmp_path):
    long = "corpus: c\nname: " + "x" * (2 << 20)
    lists = "a: &a [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]\n"
    for one, other in zip("abcde", "bcdef", strict=True):
        lists += f"{other}: &{other} [{', '.join([f'*{one}'] * 10)}]\n"
    itself = "corpus: &c [*c]"
    for text, message in ((long, "too large"), (lists, "aliases"), (itself, "aliases")):
        with pytest.raises(ConfigError, match=message):
            load_config(write(tmp_path, "a.yaml", text), Outer)
    few = "corpus: c\ninner: {steps: &s [1, 2]}\nwindow: 40000000000000000000000000000000000000.0"
    assert load_config(write(tmp_path, "a.yaml", few), Outer).window == 4e37
    with pytest.raises(ConfigError, match="not a regular file"):
        load_config(tmp_path, Outer)
    with pytest.raises(ConfigError, match="no such configuration file"):
        load_config(tmp_path / "none.yaml", Outer)
    (tmp_path / "b.yaml").write_bytes(b"corpus: \xff\xfe")
    with pytest.raises(ConfigError, match="cannot be read as text"):
        load_config(tmp_path / "b.yaml", Outer)


@pytest.mark.parametrize(("zeros", "is_read"), [(797, True), (798, False)])
def test_an_alias_counts_as_many_values_as_it_stands_for(tmp_path, zeros, is_read):
    """199 times 1001 values of a list, and four around them: 797 are left of 200,000."""
    text = f"a: &a [{'0, ' * 999}0]\nb: [{'*a, ' * 198}{'0, ' * zeros}]\n"
    path = write(tmp_path, "a.yaml", text)
    if is_read:
        assert read_yaml(path)["b"] == [[0] * 1000] * 198 + [0] * zeros
    else:
        with pytest.raises(ConfigError, match="aliases make it more than 200000 values"):
            read_yaml(path)


@pytest.mark.parametrize(
    "value", ["~nobody-here/corpus.jsonl", "\ud800", "a\0b"], ids=["user", "surrogate", "zero"]
)
def test_what_cannot_be_a_path_is_refused_with_its_key(tmp_path, value):
    path = tmp_path / "config.yaml"
    path.write_text(f"corpus: {json.dumps(value)}\n")
    with pytest.raises(ConfigError, match="corpus: .* is no path"):
        load_config(path, DiffusionConfig)
