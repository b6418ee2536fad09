"""Weight files and the JSON files beside them: what is read, and what is named where it is not."""

import json

import pytest

import audio_features as af
from audio_features.weight_files import plain_tensors, read_folder

torch = pytest.importorskip("torch")
save_file = pytest.importorskip("safetensors.torch").save_file


def refused(says: str):
    return pytest.raises(af.WeightsError, match=says)


def test_one_file_counts_before_parts_and_parts_before_old_files(tmp_path):
    index = tmp_path / "model.safetensors.index.json"
    with refused("(?=.*model.safetensors).*pytorch_model.bin"):
        read_folder(tmp_path)
    for k in range(11):
        (tmp_path / f"{k:02d}.txt").write_text("")
    with refused(r"00\.txt.*09\.txt"):
        read_folder(tmp_path)
    torch.save({"a": torch.zeros(1)}, tmp_path / "pytorch_model.bin")
    assert read_folder(tmp_path)["a"].tolist() == [0.0]
    save_file({"a": torch.ones(1)}, tmp_path / "part-1.safetensors")
    save_file({"b": torch.full((1,), 2.0)}, tmp_path / "part-2.safetensors")
    parts = {"a": "part-1.safetensors", "b": "part-2.safetensors"}
    index.write_text(json.dumps({"weight_map": parts}))
    assert {name: t.tolist() for name, t in read_folder(tmp_path).items()} == {"a": [1], "b": [2]}
    for wrong, says in (
        ({"a": "../part-1.safetensors"}, r"\['../part-1.safetensors'\]"),
        ({}, "weight_map"),
        (["part-1.safetensors"], "weight_map"),
        ({"a": "part-3.safetensors"}, "part-3.safetensors"),
    ):
        index.write_text(json.dumps({"weight_map": wrong}))
        with refused(says):
            read_folder(tmp_path)
    save_file({"a": torch.full((1,), 3.0)}, tmp_path / "model.safetensors")
    assert read_folder(tmp_path)["a"].tolist() == [3.0]


def test_tensors_claim_twice_as_much_as_their_file_at_most(tmp_path):
    path = tmp_path / "a.pt"
    path.write_bytes(bytes(100))
    fits = {"a": torch.zeros(1, dtype=torch.int8).expand(40), 7: torch.zeros(40)}
    assert set(plain_tensors(path, fits)) == {"a", "7"}
    with refused(r"(?=.*\b201\b).*\b100"):
        plain_tensors(path, {"a": torch.zeros(1, dtype=torch.int8).expand(201)})
    for odd in ([torch.zeros(1)], {"a": [1.0]}):
        with refused("a.pt"):
            plain_tensors(path, odd)
