"""WavLM weights that cannot be used, and what the command says of those that can."""

import argparse
import json
import pickle
import shutil
import zipfile
from pathlib import Path

import pytest
import soundfile
from wavlm_layouts import microsoft, torchaudio_state

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

pytestmark = pytest.mark.usefixtures("no_network")


def test_fingerprints_tell_weights_apart(wavlm_copy):
    first = af.WavLM(wavlm_copy).fingerprint
    assert first == af.WavLM(wavlm_copy, layer=1).fingerprint and len(first) == 64
    model = transformers.WavLMModel.from_pretrained(wavlm_copy)
    model.encoder.layers[2].feed_forward.output_dense.bias.data[0] += 1e-3
    model.save_pretrained(wavlm_copy)
    assert af.WavLM(wavlm_copy).fingerprint != first


def refused(path: Path, match: str | None = None) -> str:
    with pytest.raises(af.WeightsError, match=match) as caught:
        af.WavLM(path)
    message = str(caught.value)
    assert str(path) in message and len(message.splitlines()) == 1
    return message


def test_unusable_folders_are_refused_by_name(wavlm_copy, tmp_path):
    refused(tmp_path / "missing")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "config.json")
    shutil.copy(wavlm_copy / "config.json", tmp_path / "empty")
    refused(tmp_path / "empty", "model.safetensors")
    (tmp_path / "empty" / "config.json").rename(tmp_path / "empty" / "WavLM-Large.pt")
    refused(tmp_path / "empty", "WavLM-Large.pt")
    refused(wavlm_copy / "model.safetensors", "folder")
    config = json.loads((wavlm_copy / "config.json").read_text())
    for changes, complaint in (
        *(({"max_bucket_distance": v}, "max_distance") for v in ("large", 0, -8, 800.5, None, [1])),
        ({"model_type": "bert"}, "bert"),
    ):
        (wavlm_copy / "config.json").write_text(json.dumps({**config, **changes}))
        refused(wavlm_copy, complaint)
    (wavlm_copy / "config.json").write_text("[1]")
    refused(wavlm_copy, "config.json")
    (wavlm_copy / "config.json").write_text(json.dumps(config))
    (wavlm_copy / "model.safetensors").write_bytes(b"not tensors")
    refused(wavlm_copy)


def test_unusable_files_are_refused_by_name(wavlm_folder, tmp_path):
    path = tmp_path / "file.pt"
    code = f"__import__('os').system('touch {tmp_path / 'run'}')"
    torch.save(microsoft(wavlm_folder, conv_feature_layers=code), path)
    refused(path, "conv_feature")
    assert not (tmp_path / "run").exists()
    state = torchaudio_state(wavlm_folder)
    gone = "encoder.transformer.layers.1.attention.attention.in_proj_weight"

    def without(part: str) -> dict:
        return {name: tensor for name, tensor in state.items() if part not in name}

    for content, complaint in (
        ({**state, "encoder.transformer.extra": torch.zeros(1)}, r"(?=.*\b1\b).*extra"),
        (without(gone), r"(?=.*\b3\b).*q_proj"),
        ({**state, gone: torch.full((96, 32), float("nan"))}, "finite"),
        ({**state, gone: torch.zeros(1).expand(1 << 20, 1 << 20)}, "claim"),
        (microsoft(wavlm_folder)["model"], "cfg"),
        *((odd, "Microsoft") for odd in ([1, 2], torch.zeros(3), {}, {"model": {}})),
    ):
        torch.save(content, path)
        refused(path, complaint)


def test_nothing_in_a_file_is_run(wavlm_folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    class Payload:
        def __reduce__(self):
            return Path.touch, (tmp_path / "run",)

    path = tmp_path / "file.pt"
    for zipped in (True, False):
        torch.save({"weight": Payload()}, path, _use_new_zipfile_serialization=zipped)
        assert "weights_only=False" not in refused(path)
        pickle.dump({"weight": Payload()}, path.open("wb"), protocol=2 if zipped else 5)
        assert "weights_only=False" not in refused(path)
        checkpoint = microsoft(wavlm_folder)
        checkpoint["cfg"] = argparse.Namespace(**checkpoint["cfg"])
        torch.save(checkpoint, path, _use_new_zipfile_serialization=zipped)
        advice = refused(path, "argparse.Namespace")
        exec(advice[advice.index("import ") :])
        torch.serialization.clear_safe_globals()
        assert af.WavLM(tmp_path / "plain.pt").fingerprint == af.WavLM(wavlm_folder).fingerprint
    assert not (tmp_path / "run").exists()


def test_damaged_files_are_refused(wavlm_folder, tmp_path):
    good = tmp_path / "good.pt"
    path = tmp_path / "file.pt"
    torch.save(microsoft(wavlm_folder), good)
    data = good.read_bytes()
    for cut in (0, 1, 3, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        refused(path)
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    refused(path, "compressed")
    path.write_bytes(b"RIFF" + bytes(100))
    refused(path, "RIFF")


def test_the_command_says_what_it_found(wavlm_folder, tmp_path, speech, gesturekit):
    soundfile.write(tmp_path / "a.wav", speech.samples, 16_000)
    torch.save(microsoft(wavlm_folder), tmp_path / "WavLM.pt")
    weights = ("--weights", tmp_path / "WavLM.pt", "--out", tmp_path)
    options = ("--extractor", "wavlm,prosody", "--layer", "3,1", "--full-context", "2.5")
    done = gesturekit("features", tmp_path / "a.wav", *weights, *options).ok()
    said = done.out + done.err
    assert af.WavLM(wavlm_folder).fingerprint in said and "Microsoft" in said
    track = af.FeatureTrack.load(tmp_path / "a.npz")
    part = track.spec["parts"][0]
    assert part["layer"] == [3, 1] and part["full_context"] == 2.5
    assert track.values.shape[1] == 64 + 4
