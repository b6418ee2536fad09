"""Weight files and the JSON files beside them: what is read, and what is named where it is not."""

from __future__ import annotations

import json

import pytest

import audio_features as af
from audio_features.weight_files import (
    check_fingerprint,
    expected_normalization,
    plain_tensors,
    read_folder,
    read_json,
    refuse_tensors,
    weights_needed,
)

torch = pytest.importorskip("torch")
save_file = pytest.importorskip("safetensors.torch").save_file


def refused(says: str):
    return pytest.raises(af.WeightsError, match=says)


def test_a_json_file_holds_an_object_of_a_mib_at_most(tmp_path):
    path = tmp_path / "config.json"
    with refused("config.json: no such file: the folder must hold all"):
        read_json(path)
    text = json.dumps({"name": "é"}, ensure_ascii=False)
    filled = text.encode() + b" " * ((1 << 20) - len(text.encode()))
    path.write_bytes(filled)
    assert read_json(path) == {"name": "é"}
    for content, says in (
        (filled + b" ", "1048577 bytes, at most 1048576 are read: download again"),
        (b"[1]", "holds a list, expected an object"),
        (b"{", "config.json: not a configuration file: "),
        (b"\xff", "config.json: not a configuration file: "),
        (b"[" * 100_000, "config.json: not a configuration file: "),
    ):
        path.write_bytes(content)
        with refused(says):
            read_json(path)


@pytest.mark.parametrize(
    ("settings", "group", "layer"),
    [
        (None, None, 1e-7),
        ({}, 1e-7, 1e-7),
        ({"do_normalize": True}, 1e-7, 1e-7),
        ({"do_normalize": False, "sampling_rate": 16_000}, None, None),
    ],
)
def test_the_preprocessor_file_decides_before_the_kind_of_network(tmp_path, settings, group, layer):
    if settings is not None:
        (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
    assert expected_normalization(tmp_path, "group") == group
    assert expected_normalization(tmp_path, "layer") == layer


@pytest.mark.parametrize("settings", [{"sampling_rate": 8_000}, {"do_normalize": "yes"}])
def test_a_preprocessor_of_something_else_is_refused(tmp_path, settings):
    (tmp_path / "preprocessor_config.json").write_text(json.dumps(settings))
    with refused("sampling_rate .* and do_normalize .*, expected 16000 and true or false"):
        expected_normalization(tmp_path, "group")


def test_fingerprints_are_compared_where_a_spec_has_one():
    check_fingerprint("here", "abc", None)
    check_fingerprint("here", "abc", "abc")
    with refused("^here: these weights have fingerprint abc, the features were made with abd: "):
        check_fingerprint("here", "abc", "abd")
    assert str(weights_needed("WavLM", None, "how")) == (
        "weights of WavLM are needed: name their place (how)"
    )
    assert "weights of WavLM with fingerprint abc are" in str(weights_needed("WavLM", "abc", ""))


def test_one_file_counts_before_parts_and_parts_before_old_files(tmp_path):
    index = tmp_path / "model.safetensors.index.json"
    with refused("no model.safetensors and no pytorch_model.bin .found: nothing.: download"):
        read_folder(tmp_path)
    for k in range(11):
        (tmp_path / f"{k:02d}.txt").write_text("")
    with refused(r"\(found: 00.txt, 01.txt, .*, 09.txt\): download"):
        read_folder(tmp_path)
    torch.save({"a": torch.zeros(1)}, tmp_path / "pytorch_model.bin")
    assert read_folder(tmp_path)["a"].tolist() == [0.0]
    save_file({"a": torch.ones(1)}, tmp_path / "part-1.safetensors")
    save_file({"b": torch.full((1,), 2.0)}, tmp_path / "part-2.safetensors")
    parts = {"a": "part-1.safetensors", "b": "part-2.safetensors"}
    index.write_text(json.dumps({"weight_map": parts}))
    assert {name: t.tolist() for name, t in read_folder(tmp_path).items()} == {"a": [1], "b": [2]}
    for wrong, says in (
        ({"a": "../part-1.safetensors"}, r"names \['../part-1.safetensors'\], expected files of"),
        ({}, "weight_map names no files, expected files of this folder"),
        (["part-1.safetensors"], "weight_map names no files"),
        ({"a": "part-3.safetensors"}, "part-3.safetensors is missing: download all parts"),
    ):
        index.write_text(json.dumps({"weight_map": wrong}))
        with refused(says):
            read_folder(tmp_path)
    save_file({"a": torch.full((1,), 3.0)}, tmp_path / "model.safetensors")
    assert read_folder(tmp_path)["a"].tolist() == [3.0]


@pytest.mark.parametrize(
    ("count", "listed"),
    [(8, "0; 1; 2; 3; 4; 5; 6; 7"), (10, "0; 1; 2; 3; 4; 5; 6; 7; and 2 more")],
)
def test_eight_tensors_are_listed(tmp_path, count, listed):
    names = list(map(str, reversed(range(count))))
    with refused(f"^here: {count} tensors are missing \\({listed}\\): do this$"):
        refuse_tensors("here", {"unknown": [], "missing": names}, "do this")
    refuse_tensors("here", {"unknown": [], "missing": []}, "do this")


def test_tensors_claim_twice_as_much_as_their_file_at_most(tmp_path):
    path = tmp_path / "a.pt"
    path.write_bytes(bytes(100))
    fits = {"a": torch.zeros(1, dtype=torch.int8).expand(40), 7: torch.zeros(40)}
    assert set(plain_tensors(path, fits)) == {"a", "7"}
    with refused("the tensors claim 201 bytes, the file has 100: download it again"):
        plain_tensors(path, {"a": torch.zeros(1, dtype=torch.int8).expand(201)})
    for odd in ([torch.zeros(1)], {"a": [1.0]}):
        with refused("a.pt: holds no plain table of tensors"):
            plain_tensors(path, odd)
