"""WavLM weights as Hugging Face, Microsoft and torchaudio lay them out, and files that are none."""

from __future__ import annotations

import argparse
import importlib.util
import json
import re
import shutil
import subprocess
import sys
import types
import zipfile
from pathlib import Path

import numpy as np
import pytest
import soundfile
from click.testing import CliRunner

import audio_features as af

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")
load_file = pytest.importorskip("safetensors.torch").load_file

pytestmark = pytest.mark.usefixtures("no_network")

# transformers' names to Microsoft's.
MICROSOFT = [
    (r"conv_layers\.(\d+)\.conv\.", r"conv_layers.\1.0."),
    (r"feature_projection\.layer_norm", "layer_norm"),
    (r"feature_projection\.projection", "post_extract_proj"),
    (r"pos_conv_embed\.conv\.", "pos_conv.0."),
    (r"masked_spec_embed", "mask_emb"),
    (r"(layers\.\d+)\.layer_norm", r"\1.self_attn_layer_norm"),
    (r"(layers\.\d+)\.attention\.", r"\1.self_attn."),
    (r"gru_rel_pos_linear", "grep_linear"),
    (r"gru_rel_pos_const", "grep_a"),
    (r"rel_attn_embed", "relative_attention_bias"),
    (r"feed_forward\.intermediate_dense", "fc1"),
    (r"feed_forward\.output_dense", "fc2"),
]
OLD_NORM = [(r"parametrizations\.weight\.original0", "weight_g")]
OLD_NORM += [(r"parametrizations\.weight\.original1", "weight_v")]
CONVOLUTIONS = "[(16,10,5)] + [(16,3,2)] * 4 + [(16,2,2)] * 2"


def renamed(tensors: dict, *tables: list) -> dict:
    found = {}
    for name, tensor in tensors.items():
        for table in tables:
            for pattern, replacement in table:
                name = re.sub(pattern, replacement, name)
        found[name] = tensor
    return found


def microsoft(folder: Path, **changes) -> dict:
    """Microsoft's checkpoint of the network in a Hugging Face folder."""
    config = json.loads((folder / "config.json").read_text())
    large = config["feat_extract_norm"] == "layer"
    norm = [(r"(conv_layers\.\d+)\.layer_norm\.", r"\1.2.1." if large else r"\1.2.")]
    cfg = {
        "extractor_mode": "layer_norm" if large else "default",
        "encoder_layers": config["num_hidden_layers"],
        "encoder_embed_dim": config["hidden_size"],
        "encoder_ffn_embed_dim": config["intermediate_size"],
        "encoder_attention_heads": config["num_attention_heads"],
        "activation_fn": "gelu",
        "layer_norm_first": large,
        "conv_feature_layers": CONVOLUTIONS,
        "conv_bias": False,
        "normalize": large,
        "conv_pos": config["num_conv_pos_embeddings"],
        "conv_pos_groups": config["num_conv_pos_embedding_groups"],
        "relative_position_embedding": True,
        "num_buckets": config["num_buckets"],
        "max_distance": config["max_bucket_distance"],
        "gru_rel_pos": True,
        "mask_prob": 0.8,
    }
    tensors = load_file(folder / "model.safetensors")
    return {"cfg": {**cfg, **changes}, "model": renamed(tensors, norm, MICROSOFT, OLD_NORM)}


def torchaudio_state(folder: Path) -> dict:
    """The state dict that torchaudio's model of the same network has."""
    found = {}
    for name, tensor in load_file(folder / "model.safetensors").items():
        name = name.replace("attention.out_proj", "attention.attention.out_proj")
        if name.startswith("encoder."):
            name = name.replace("encoder.", "encoder.transformer.", 1)
        elif name.startswith("feature_projection"):
            name = f"encoder.{name}"
        found[name] = tensor
    found.pop("masked_spec_embed")
    for name in [name for name in found if "q_proj" in name]:
        stacked = [found.pop(name.replace("q_proj", f"{part}_proj")) for part in "qkv"]
        found[name.replace("q_proj.", "attention.in_proj_")] = torch.cat(stacked)
    return found


@pytest.fixture(scope="module", params=["group", "layer"])
def folder(request, tmp_path_factory, write_wavlm) -> Path:
    """A Hugging Face folder in which no tensor is all zeros or ones."""
    path = tmp_path_factory.mktemp(request.param)
    model = write_wavlm(path, norm=request.param)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    model.save_pretrained(path)
    return path


@pytest.fixture
def copy(folder, tmp_path) -> Path:
    """The folder again, to be changed."""
    shutil.copytree(folder, tmp_path / "copy")
    return tmp_path / "copy"


def layouts(folder: Path, out: Path) -> list[Path]:
    """The same network in every layout and spelling."""
    tensors = load_file(folder / "model.safetensors")
    headed = {f"wavlm.{name}": tensor for name, tensor in renamed(tensors, OLD_NORM).items()}
    headed |= {"lm_head.weight": torch.zeros(3), "feature_extractor.weight": torch.zeros(3)}
    (out / "headed").mkdir()
    shutil.copy(folder / "config.json", out / "headed")
    torch.save(headed, out / "headed" / "pytorch_model.bin")
    torch.save(microsoft(folder), out / "WavLM.pt")
    torch.save(microsoft(folder), out / "legacy.pt", _use_new_zipfile_serialization=False)
    state = torchaudio_state(folder)
    torch.save(state, out / "torchaudio.pth")
    wrapped = {f"model.{name}": tensor for name, tensor in renamed(state, OLD_NORM).items()}
    torch.save({**wrapped, "aux.weight": torch.zeros(3)}, out / "wrapped.pth")
    names = ("headed", "WavLM.pt", "legacy.pt", "torchaudio.pth", "wrapped.pth")
    return [folder, *(out / name for name in names)]


def test_all_layouts_of_one_network_give_the_same_features(folder, tmp_path, speech):
    model = transformers.WavLMModel.from_pretrained(folder)
    large = model.config.do_stable_layer_norm
    extractor = transformers.Wav2Vec2FeatureExtractor(do_normalize=large)
    inputs = extractor(speech.samples, sampling_rate=16_000, return_tensors="pt").input_values
    with torch.no_grad():
        truth = model(inputs).last_hidden_state[0].numpy()
    paths = layouts(folder, tmp_path)
    for path in paths:
        wavlm = af.WavLM(path, normalize=1e-7 if large else False)
        values = wavlm.extract(speech).values
        assert np.linalg.norm(values - truth) < 1e-5 * np.linalg.norm(truth), path
    found = [af.WavLM(path) for path in paths]
    assert len({wavlm.fingerprint for wavlm in found}) == 1
    assert [wavlm.weights.layout.split()[0] for wavlm in found] == [
        "Hugging",
        "Hugging",
        *("Microsoft",) * 2,
        *("torchaudio",) * 2,
    ]
    for wavlm in found:
        text = wavlm.weights.describe()
        assert wavlm.fingerprint in text and "3 layers of 32, 4 heads" in text
        assert ("mean 0" in text) == large


def test_a_model_of_one_layout_takes_the_weights_of_another(folder, tmp_path, speech):
    """Even in near silence, where the three code bases' normalisations differ."""
    torch.save(microsoft(folder), tmp_path / "WavLM.pt")
    quiet = af.Wave(speech.samples * np.float32(1e-3), 16_000)
    trained = af.WavLM(folder)
    again = af.extractor_from_spec(trained.spec, weights=tmp_path / "WavLM.pt")
    np.testing.assert_array_equal(again.extract(quiet).values, trained.extract(quiet).values)
    own = af.WavLM(tmp_path / "WavLM.pt")
    large = trained.normalize is not None
    assert (own.normalize, trained.normalize) == ((1e-5, 1e-7) if large else (None, None))
    differ = np.abs(own.extract(quiet).values - trained.extract(quiet).values).max() > 1e-3
    assert differ == large


def test_microsofts_normalisation_is_layer_norm_over_the_waveform(folder, tmp_path, speech):
    torch.save(microsoft(folder, normalize=True), tmp_path / "WavLM.pt")
    samples = torch.from_numpy(speech.samples * np.float32(1e-2))
    normal = torch.nn.functional.layer_norm(samples, samples.shape)
    model = transformers.WavLMModel.from_pretrained(folder)
    with torch.no_grad():
        truth = model(normal[None]).last_hidden_state[0].numpy()
    values = af.WavLM(tmp_path / "WavLM.pt").extract(af.Wave(samples.numpy(), 16_000)).values
    assert np.linalg.norm(values - truth) < 1e-5 * np.linalg.norm(truth)


def test_the_preprocessor_file_decides_on_normalisation(copy, speech):
    file = copy / "preprocessor_config.json"
    file.write_text(json.dumps({"do_normalize": False, "sampling_rate": 16_000}))
    plain = af.WavLM(copy)
    file.write_text(json.dumps({"do_normalize": True, "sampling_rate": 16_000}))
    normalised = af.WavLM(copy)
    assert (plain.normalize, normalised.normalize) == (None, 1e-7)
    assert np.abs(normalised.extract(speech).values - plain.extract(speech).values).max() > 1e-4
    file.write_text(json.dumps({"sampling_rate": 8_000}))
    with pytest.raises(af.WeightsError, match="8000"):
        af.WavLM(copy)


def test_the_reach_of_positions_is_the_checkpoints_own(folder, copy, tmp_path, speech):
    """Published models say 800; Microsoft's class has 1280 where a checkpoint is silent."""
    config = json.loads((copy / "config.json").read_text())
    (copy / "config.json").write_text(json.dumps({**config, "max_bucket_distance": 200}))
    torch.save(microsoft(folder, max_distance=200), tmp_path / "near.pt")
    paths = (copy, tmp_path / "near.pt", folder)
    other, near, usual = (af.WavLM(path, normalize=False) for path in paths)
    values = other.extract(speech).values
    np.testing.assert_allclose(near.extract(speech).values, values, atol=1e-4)
    assert np.abs(usual.extract(speech).values - values).max() > 1e-4
    assert near.fingerprint == other.fingerprint != usual.fingerprint
    checkpoint = microsoft(folder)
    del checkpoint["cfg"]["max_distance"]
    torch.save(checkpoint, tmp_path / "silent.pt")
    with pytest.raises(af.WeightsError, match="lacks max_distance"):
        af.WavLM(tmp_path / "silent.pt")


def test_fingerprints_tell_weights_apart(copy):
    first = af.WavLM(copy).fingerprint
    assert first == af.WavLM(copy, layer=1).fingerprint and len(first) == 64
    model = transformers.WavLMModel.from_pretrained(copy)
    model.encoder.layers[2].feed_forward.output_dense.bias.data[0] += 1e-3
    model.save_pretrained(copy)
    assert af.WavLM(copy).fingerprint != first


def refused(path: Path, match: str) -> str:
    with pytest.raises(af.WeightsError, match=match) as caught:
        af.WavLM(path)
    message = str(caught.value)
    assert str(path) in message and len(message.splitlines()) == 1
    return message


def test_folders_that_cannot_be_used_are_refused_by_name(copy, tmp_path):
    refused(tmp_path / "missing", "no such folder or file")
    (tmp_path / "empty").mkdir()
    refused(tmp_path / "empty", "config.json: no such file")
    shutil.copy(copy / "config.json", tmp_path / "empty")
    refused(tmp_path / "empty", "no model.safetensors")
    (tmp_path / "empty" / "config.json").rename(tmp_path / "empty" / "WavLM-Large.pt")
    refused(tmp_path / "empty", "name the file, .*WavLM-Large.pt")
    refused(copy / "model.safetensors", "name the folder")

    config = json.loads((copy / "config.json").read_text())

    def with_config(**changes) -> None:
        (copy / "config.json").write_text(json.dumps({**config, **changes}))

    with_config(num_hidden_layers=4)
    refused(copy, "19 tensors are missing .*encoder.layers.3.*and 11 more")
    with_config(num_hidden_layers=2)
    refused(copy, "tensors are unknown")
    with_config(intermediate_size=48)
    refused(copy, "another shape")
    with_config(num_attention_heads=5)
    refused(copy, "describes no WavLM network")
    for value in ("large", 0, -8, 1 << 60, 32.0, True, None, [32]):
        with_config(hidden_size=value)
        refused(copy, "width")
    with_config(num_hidden_layers=10**9)
    refused(copy, "layers")
    with_config(hidden_act="relu")
    refused(copy, "relu")
    with_config(conv_stride=[5, 2, 2, 2, 2, 2, 1])
    refused(copy, "every 160")
    with_config(conv_dim=[16] * 6)
    refused(copy, "channels")
    with_config(model_type="bert")
    refused(copy, "bert")
    (copy / "config.json").write_text("[1]")
    refused(copy, "not a configuration file")
    with_config()
    (copy / "model.safetensors").write_bytes(b"not tensors")
    refused(copy, "cannot be read as weights")


def test_files_that_cannot_be_used_are_refused_by_name(folder, tmp_path):
    path = tmp_path / "file.pt"
    for change, complaint in (
        ({"conv_feature_layers": "__import__('os').system('touch /tmp/run')"}, "conv_feature"),
        ({"conv_feature_layers": "[(16,10,5)] * 9"}, "seven"),
        ({"gru_rel_pos": False}, "gru_rel_pos"),
        ({"activation_fn": "glu"}, "glu"),
        ({"extractor_mode": ["default"]}, "front_norm"),
        ({"encoder_layers": 2}, "unknown"),
    ):
        torch.save(microsoft(folder, **change), path)
        refused(path, complaint)
    state = torchaudio_state(folder)
    torch.save({**state, "encoder.transformer.extra": torch.zeros(1)}, path)
    refused(path, "unknown .*extra")
    gone = "encoder.transformer.layers.1.attention.attention.in_proj_weight"
    torch.save({name: tensor for name, tensor in state.items() if name != gone}, path)
    refused(path, "3 tensors are missing")
    torch.save({name: t for name, t in state.items() if "gru_rel_pos_const" not in name}, path)
    refused(path, "gru_rel_pos_const")
    torch.save({**state, gone: torch.full((96, 32), float("nan"))}, path)
    refused(path, "not finite")
    torch.save({**state, gone: torch.zeros(96, 32, dtype=torch.int8)}, path)
    refused(path, "floating point")
    torch.save({**state, gone: torch.zeros(1).expand(1 << 20, 1 << 20)}, path)
    refused(path, "claim to be")
    torch.save(microsoft(folder)["model"], path)
    refused(path, "without their cfg")
    for content in ({"weight": torch.zeros(3)}, [1, 2], torch.zeros(3), {}, {"model": {}}):
        torch.save(content, path)
        refused(path, "no WavLM in a known layout")


def test_nothing_in_a_file_is_run(folder, tmp_path):
    class Payload:
        def __reduce__(self):
            return Path.touch, (tmp_path / "run",)

    path = tmp_path / "file.pt"
    for zipped in (True, False):
        torch.save({"weight": Payload()}, path, _use_new_zipfile_serialization=zipped)
        refused(path, "cannot be read|could run code")
        checkpoint = microsoft(folder)
        checkpoint["cfg"] = argparse.Namespace(**checkpoint["cfg"])
        torch.save(checkpoint, path, _use_new_zipfile_serialization=zipped)
        assert "vars(c['cfg'])" in refused(path, "argparse.Namespace")
    assert not (tmp_path / "run").exists()


def test_damaged_files_are_refused(folder, tmp_path):
    good = tmp_path / "good.pt"
    path = tmp_path / "file.pt"
    torch.save(microsoft(folder), good)
    data = good.read_bytes()
    rng = np.random.default_rng(0)
    for cut in (0, 1, 3, 100, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:cut])
        refused(path, "cannot be read as weights")
    for _ in range(30):
        changed = bytearray(data)
        for at in rng.integers(0, len(data), 20):
            changed[at] = rng.integers(256)
        path.write_bytes(changed)
        try:
            af.WavLM(path)
        except af.WeightsError as error:
            assert str(path) in str(error)
    with zipfile.ZipFile(good) as old, zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for entry in old.namelist():
            new.writestr(entry, old.read(entry))
    refused(path, "compressed")


def test_the_command_says_what_it_found(folder, tmp_path, speech):
    from gesturekit.cli.features import command

    soundfile.write(tmp_path / "a.wav", speech.samples, 16_000)
    torch.save(microsoft(folder), tmp_path / "WavLM.pt")

    def run(*options: str):
        arguments = [tmp_path / "a.wav", "--weights", tmp_path / "WavLM.pt", "--out", tmp_path]
        arguments += ["--extractor", "wavlm,prosody", *options]
        done = CliRunner().invoke(command, [*map(str, arguments)], standalone_mode=False)
        assert done.exception is None, done.output
        return done.output, af.FeatureTrack.load(tmp_path / "a.npz")

    said, track = run("--layer", "3,1", "--full-context", "2.5")
    assert af.WavLM(folder).weights.fingerprint in said and "Microsoft checkpoint" in said
    part = track.spec["parts"][0]
    assert part["layer"] == [3, 1] and part["full_context"] == 2.5
    assert track.values.shape[1] == 64 + 4
    assert run("--layer", "1:1,3:2", "--dtype", "bf16")[1].spec["parts"][0]["dtype"] == "bf16"
    assert run("--preset", "dsg")[1].spec["parts"][0]["preset"] == "dsg"


def test_a_broken_torchaudio_is_not_noticed(folder, tmp_path, speech):
    """As the registry's torchaudio is beside a CPU build of torch: it cannot be imported."""
    broken = tmp_path / "site" / "torchaudio"
    broken.mkdir(parents=True)
    message = "libtorch_cuda.so: cannot open shared object file"
    (broken / "__init__.py").write_text(f"raise OSError({message!r})\n")
    np.save(tmp_path / "samples.npy", speech.samples)
    code = f"""
import sys
sys.path.insert(0, {str(tmp_path / "site")!r})
try:
    import torchaudio
except OSError:
    pass
else:
    raise SystemExit("torchaudio is not broken")
import numpy as np
import audio_features as af
wave = af.Wave(np.load({str(tmp_path / "samples.npy")!r}), 16_000)
np.save({str(tmp_path / "values.npy")!r}, af.WavLM({str(folder)!r}).extract(wave).values)
assert "transformers" not in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    values = np.load(tmp_path / "values.npy")
    np.testing.assert_allclose(values, af.WavLM(folder).extract(speech).values, atol=1e-4)


@pytest.fixture
def torchaudio(monkeypatch):
    """torchaudio where it is installed; without its extension where that does not load."""
    if importlib.util.find_spec("torchaudio") is None:
        pytest.skip("torchaudio is not installed")
    try:
        return importlib.import_module("torchaudio")
    except OSError:
        stub = types.ModuleType("torchaudio._extension")
        stub._IS_TORCHAUDIO_EXT_AVAILABLE = stub._IS_ALIGN_AVAILABLE = False
        stub.fail_if_no_align = lambda function: function
        monkeypatch.setitem(sys.modules, "torchaudio._extension", stub)
        return importlib.import_module("torchaudio")


@pytest.mark.parametrize("mode", ["group_norm", "layer_norm"])
def test_a_state_dict_of_torchaudio_gives_its_own_models_features(
    torchaudio, mode, tmp_path, speech
):
    large = mode == "layer_norm"
    kernels = (10, 3, 3, 3, 3, 2, 2)
    model = torchaudio.models.wavlm_model(
        extractor_mode=mode,
        extractor_conv_layer_config=[(16, k, 2 if i else 5) for i, k in enumerate(kernels)],
        extractor_conv_bias=False,
        encoder_embed_dim=32,
        encoder_projection_dropout=0.0,
        encoder_pos_conv_kernel=16,
        encoder_pos_conv_groups=4,
        encoder_num_layers=3,
        encoder_num_heads=4,
        encoder_num_buckets=320,
        encoder_max_distance=800,
        encoder_attention_dropout=0.0,
        encoder_ff_interm_features=64,
        encoder_ff_interm_dropout=0.0,
        encoder_dropout=0.0,
        encoder_layer_norm_first=large,
        encoder_layer_drop=0.0,
        aux_num_out=None,
    ).eval()
    samples = torch.from_numpy(speech.samples)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
        sound = torch.nn.functional.layer_norm(samples, samples.shape) if large else samples
        layers, _ = model.extract_features(sound[None])
        last, _ = model(sound[None])
    torch.save(model.state_dict(), tmp_path / "model.pth")
    for layer, truth in (("last", last), *enumerate(layers, 1)):
        values = af.WavLM(tmp_path / "model.pth", layer=layer).extract(speech).values
        truth = truth[0].numpy()
        assert np.linalg.norm(values - truth) < 1e-5 * np.linalg.norm(truth), layer
