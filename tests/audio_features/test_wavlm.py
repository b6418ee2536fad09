"""WavLM features: the values of transformers' own forward, whole and in chunks."""

from __future__ import annotations

import json
import os
import warnings

import numpy as np
import pytest
from sounds import distance, swelling
from wavlm_layouts import microsoft

import audio_features as af
from audio_features.speech_encoders import chunk_slices

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

pytestmark = pytest.mark.usefixtures("no_network")

# With GESTUREKIT_FULL_SIZE=1 the same comparison runs on networks of the published sizes.
FULL_SIZE = bool(os.environ.get("GESTUREKIT_FULL_SIZE"))
SECONDS = (0.1, 1.0, 10.0, 30.0, 60.0) if FULL_SIZE else (0.1, 1.0, 10.0)


@pytest.fixture(scope="module", params=["group", "layer"])
def network(request, tmp_path_factory, write_wavlm):
    """A folder, transformers' own model, and whether it wants a normalised waveform."""
    folder = tmp_path_factory.mktemp(request.param)
    large = request.param == "layer"
    if FULL_SIZE:
        sizes = {"hidden_size": 1024, "num_hidden_layers": 24, "num_attention_heads": 16}
        sizes |= {"intermediate_size": 4096, "feat_extract_norm": "layer"}
        sizes |= {"do_stable_layer_norm": True}
        model = transformers.WavLMModel(transformers.WavLMConfig(**sizes if large else {})).eval()
    else:
        model = write_wavlm(folder, norm=request.param)
    make_lively(model)
    model.save_pretrained(folder)
    return folder, model, large


def make_lively(model, seed: int = 0) -> None:
    """Weights in which everything counts: fresh ones have no biases and next to no positions."""
    rng = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for name, parameter in model.named_parameters():
            noise = torch.randn(parameter.shape, generator=rng)
            if "rel_attn_embed" in name:
                parameter.copy_(noise)
            elif "gru_rel_pos" in name:
                parameter.add_(0.3 * noise)
            elif parameter.ndim == 1:
                parameter.add_(0.1 * noise)
            elif "q_proj" in name or "k_proj" in name:
                parameter.mul_(3.0)


def of_transformers(model, samples: np.ndarray, normalize: bool):
    """(last hidden state, all hidden states), each (T, width)."""
    if normalize:
        extractor = transformers.Wav2Vec2FeatureExtractor(do_normalize=True)
        samples = extractor(samples, sampling_rate=16_000).input_values[0]
    with torch.no_grad():
        out = model(torch.from_numpy(samples)[None], output_hidden_states=True)
    return out.last_hidden_state[0].numpy(), [state[0].numpy() for state in out.hidden_states]


@pytest.mark.parametrize("seconds", SECONDS)
def test_values_are_those_of_transformers(network, seconds):
    folder, model, large = network
    samples = swelling(seconds)
    last, states = of_transformers(model, samples, normalize=large)
    wave = af.Wave(samples, 16_000)
    track = af.WavLM(folder).extract(wave)
    assert distance(track.values, last) < 1e-5
    assert len(track.values) == (len(samples) - 400) // 320 + 1
    np.testing.assert_allclose(track.times, 0.0125 + 0.02 * np.arange(len(track.times)))
    every = af.WavLM(folder, layer=list(range(len(states)))).extract(wave).values
    for index, (ours, theirs) in enumerate(zip(np.split(every, len(states), axis=1), states)):
        assert distance(ours, theirs) < 1e-5, index
    below = len(states) // 2
    assert distance(af.WavLM(folder, layer=below).extract(wave).values, states[below]) < 1e-5


@pytest.mark.parametrize(
    ("n_frames", "longest", "context", "chunks"),
    [
        (10, 20, 2, [((0, 10), (0, 10))]),
        (10, 20, 6, [((0, 10), (0, 10))]),
        (10, 6, 1, [((0, 6), (0, 5)), ((4, 10), (5, 10))]),
        (11, 6, 1, [((0, 5), (0, 4)), ((3, 8), (4, 7)), ((6, 11), (7, 11))]),
        (9, 3, 0, [((0, 3), (0, 3)), ((3, 6), (3, 6)), ((6, 9), (6, 9))]),
    ],
)
def test_chunks_are_few_of_one_length_and_overlap_by_their_contexts(
    n_frames, longest, context, chunks
):
    found = list(chunk_slices(n_frames, longest, context))
    assert [((a.start, a.stop), (b.start, b.stop)) for a, b in found] == chunks


def test_kernels_may_be_longer_than_two_strides(tmp_path):
    """Their window is that of the published models, 400 samples."""
    sizes = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 4}
    sizes |= {"conv_dim": [8] * 7, "conv_kernel": [10, 5, 2, 3, 3, 2, 2], "intermediate_size": 32}
    sizes |= {"num_conv_pos_embeddings": 16, "num_conv_pos_embedding_groups": 4}
    model = transformers.WavLMModel(transformers.WavLMConfig(**sizes)).eval()
    make_lively(model)
    model.save_pretrained(tmp_path)
    samples = swelling(0.3)
    last, _ = of_transformers(model, samples, normalize=False)
    assert distance(af.WavLM(tmp_path).extract(af.Wave(samples, 16_000)).values, last) < 1e-5


def test_both_implementations_agree(network, tmp_path):
    wave = af.Wave(swelling(3.0), 16_000)
    for settings in ({}, {"layer": [0, 2], "final_norm": False}, {"layer": "mean"}):
        ours = af.WavLM(network[0], **settings)
        theirs = af.WavLM(network[0], **settings, implementation="transformers")
        assert distance(ours.extract(wave).values, theirs.extract(wave).values) < 1e-5
        assert ours.fingerprint == theirs.fingerprint and ours.names == theirs.names
    spec = theirs.spec
    assert spec.pop("implementation") == "transformers" and spec == ours.spec
    again = af.extractor_from_spec(theirs.spec, weights=network[0])
    assert again.implementation == "transformers"
    long = {"full_context": 0.5, "chunk": 2.5, "context": 1.0}
    ours = af.WavLM(network[0], **long).extract(wave).values
    theirs = af.WavLM(network[0], **long, implementation="transformers").extract(wave).values
    assert distance(ours, theirs) < 0.05
    torch.save(microsoft(network[0]), tmp_path / "WavLM-Tiny.pt")
    of_microsoft = af.WavLM(tmp_path / "WavLM-Tiny.pt", implementation="transformers")
    assert of_microsoft.fingerprint == again.fingerprint
    for wrong in ({"implementation": "slow"}, {"implementation": "transformers", "dtype": "bf16"}):
        with pytest.raises(af.FeatureError, match="transformers"):
            af.WavLM(network[0], **wrong)


@pytest.mark.parametrize("n", [400, 719, 720, 721, 1040, 16_000 + 79])
def test_the_shortest_sounds_and_the_edges_between_frame_counts(network, n):
    folder, model, large = network
    samples = swelling(1.1)[:n]
    ours = af.WavLM(folder).extract(af.Wave(samples, 16_000)).values
    assert distance(ours, of_transformers(model, samples, normalize=large)[0]) < 1e-5


def test_sound_of_another_rate_and_silence(network):
    extractor = af.WavLM(network[0])
    for rate in (8_000, 11_025, 44_100, 48_000):
        short = af.Wave(swelling(0.1)[: -(-rate // 40)], rate)  # 25 ms
        assert extractor.extract(short).values.shape == (1, extractor.dim)
    with pytest.raises(af.AudioError, match="at least 25 ms"):
        extractor.extract(af.Wave(np.zeros(399, np.float32), 16_000))
    silence = np.zeros(16_000, np.float32)
    ours = extractor.extract(af.Wave(silence, 16_000)).values
    theirs = of_transformers(network[1], silence, normalize=network[2])[0]
    assert distance(ours, theirs) < 1e-5


@pytest.mark.parametrize("block", [1, 7, 64, 10_000])
def test_the_front_end_gives_the_same_in_blocks_of_any_size(network, block):
    from audio_features.wavlm.front_end import FrontEnd
    from audio_features.wavlm.weights import read_weights

    folder, model, _ = network
    weights, tensors = read_weights(folder)
    front = FrontEnd(weights.architecture, tensors, torch.float32)
    samples = torch.from_numpy(swelling(1.5))
    with torch.no_grad():
        n_frames = (len(samples) - 400) // 320 + 1
        ours = front.frames(samples, 0, n_frames, front.for_sound(samples), block)
        features = model.feature_extractor(samples[None]).transpose(1, 2)
        theirs = model.feature_projection(features)[0][0]
    assert distance(ours.numpy(), theirs.numpy()) < 1e-5


def test_inputs_of_the_transformer_are_exact_in_chunks(network):
    """Convolutions, normalisation over the whole sound, positions: no seam, no drift."""
    folder, model, large = network
    samples = swelling(7.3)
    state = of_transformers(model, samples, normalize=large)[1][0]
    for chunk, context in ((1.0, 0.2), (0.5, 0.0), (3.33, 0.5), (20.0, 2.0)):
        extractor = af.WavLM(folder, layer=0, full_context=1.0, chunk=chunk, context=context)
        assert distance(extractor.extract(af.Wave(samples, 16_000)).values, state) < 1e-5


def test_chunks_follow_each_other_and_see_their_context():
    rng = np.random.default_rng(0)
    for _ in range(500):
        context = int(rng.integers(0, 20))
        longest = 2 * context + int(rng.integers(1, 60))
        n = int(rng.integers(1, 400))
        chunks = list(chunk_slices(n, longest, context))
        assert len({seen.stop - seen.start for seen, _ in chunks}) == 1
        assert [f for _, keep in chunks for f in range(keep.start, keep.stop)] == list(range(n))
        for seen, keep in chunks:
            assert seen.start >= 0 and seen.stop <= n and seen.stop - seen.start <= longest
            assert seen.start == 0 or keep.start - seen.start >= context
            assert seen.stop == n or seen.stop - keep.stop >= context


def test_chunked_values_come_near_the_whole_as_chunks_grow(network):
    folder, _, _ = network
    wave = af.Wave(swelling(12.0), 16_000)
    whole = af.WavLM(folder).extract(wave).values
    errors = []
    for chunk, context in ((1.0, 0.1), (6.0, 2.0), (12.0, 5.0)):
        chunked = af.WavLM(folder, full_context=0.0, chunk=chunk, context=context)
        errors.append(distance(chunked.extract(wave).values, whole))
    assert errors[0] > errors[1] > errors[2]
    assert errors[2] < 1e-5  # one chunk holds everything


def test_chunks_in_a_batch_equal_single_chunks(network):
    from audio_features.wavlm.encoder import Encoder
    from audio_features.wavlm.weights import read_weights

    weights, tensors = read_weights(network[0])
    encoder = Encoder(weights.architecture, tensors, weights.architecture.layers, torch.float32)
    windows = torch.randn(3, 60 + sum(encoder.reach), weights.architecture.width)
    with torch.no_grad():
        *_, together = encoder.states(windows)
        for window, expected in zip(windows, together):
            *_, alone = encoder.states(window[None])
            assert distance(alone[0].numpy(), expected.numpy()) < 1e-5


def test_layers_side_by_side_and_averaged(network):
    folder, model, large = network
    samples = swelling(1.0)
    last, states = of_transformers(model, samples, normalize=large)
    wave = af.Wave(samples, 16_000)
    top = len(states) - 1
    pair = af.WavLM(folder, layer=[top, 1])
    assert distance(pair.extract(wave).values, np.concatenate([states[top], states[1]], 1)) < 1e-5
    assert len(set(pair.names)) == pair.dim == 2 * last.shape[1]
    mean = af.WavLM(folder, layer="mean")
    assert distance(mean.extract(wave).values, np.mean(states, axis=0)) < 1e-5
    weighted = af.WavLM(folder, layer={1: 1.0, top: 3.0}).extract(wave).values
    assert distance(weighted, 0.25 * states[1] + 0.75 * states[top]) < 1e-5
    # Large ends in a normalisation that its topmost layer has not had.
    assert large == (distance(states[top], last) > 0.01)
    named = af.WavLM(folder, layer=top, final_norm=True).extract(wave).values
    raw = af.WavLM(folder, final_norm=False).extract(wave).values
    assert distance(named, last) < 1e-5 and distance(raw, states[top]) < 1e-5


@pytest.mark.parametrize(
    ("settings", "complaint"),
    [
        ({"layer": 4}, "from 0 to 3"),
        ({"layer": -1}, "from 0 to 3"),
        ({"layer": 1.0}, "from 0 to 3"),
        ({"layer": "first"}, "from 0 to 3"),
        ({"layer": []}, "at least one"),
        ({"layer": [1, 1]}, "once"),
        ({"layer": {1: "x"}}, "not a number"),
        ({"layer": {1: 1.0, 2: -1.0}}, "sum to 0"),
        ({"layer": 1, "final_norm": True}, "layer 3 alone"),
        ({"dtype": "fp16"}, "bf16"),
        ({"chunk": 2.0, "context": 1.0}, "longer than twice"),
        ({"full_context": float("inf")}, "seconds"),
        ({"normalize": True}, "between 0 and 1"),
        ({"preset": "dsg++"}, "dsg"),
        ({"preset": "dsg", "layer": 1}, "leave them out"),
        ({"device": "abacus"}, "device='abacus'"),
        ({"layers": 2}, "unknown setting .layers."),
    ],
    ids=str,
)
def test_settings_that_make_no_sense_are_refused(tmp_path, write_wavlm, settings, complaint):
    write_wavlm(tmp_path)
    with pytest.raises(af.FeatureError, match=complaint):
        af.WavLM(tmp_path, **settings)


def test_bf16_is_close_and_changes_the_spec(network):
    wave = af.Wave(swelling(2.0), 16_000)
    exact, quick = (af.WavLM(network[0], dtype=dtype) for dtype in ("fp32", "bf16"))
    assert 1e-5 < distance(quick.extract(wave).values, exact.extract(wave).values) < 0.05
    assert quick.spec != exact.spec


def test_bf16_convolves_in_single_precision(network, speech, monkeypatch):
    # oneDNN's convolution in bfloat16 gives garbage for few channels a group on CPUs with AMX.
    own, kinds = torch.nn.functional.conv1d, set()

    def convolve(x, weight, *args, **options):
        kinds.update((x.dtype, weight.dtype))
        return own(x, weight, *args, **options)

    monkeypatch.setattr(torch.nn.functional, "conv1d", convolve)
    af.WavLM(network[0], dtype="bf16").extract(speech)
    assert kinds == {torch.float32}


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"layer": (0, 2), "dtype": "bf16"},
        {"layer": {1: 1, 3: 2.5}, "final_norm": True},
        {"full_context": 0.5, "chunk": 0.6, "context": 0.1, "normalize": 1e-5},
        {"preset": "dsg+"},
    ],
    ids=str,
)
def test_a_spec_makes_the_same_features_again(network, speech, settings):
    extractor = af.WavLM(network[0], **settings)
    spec = json.loads(json.dumps(extractor.spec))
    again = af.extractor_from_spec(spec, weights=network[0])
    assert again.spec == extractor.spec
    np.testing.assert_array_equal(again.extract(speech).values, extractor.extract(speech).values)


def test_a_spec_requires_the_weights_of_its_fingerprint(network, tmp_path, speech, write_wavlm):
    extractor = af.WavLM(network[0], layer=2)
    # Other settings have their defaults.
    spec = {"kind": "wavlm", "layer": 2, "fingerprint": extractor.fingerprint}
    short = af.extractor_from_spec(spec, weights=network[0])
    np.testing.assert_array_equal(short.extract(speech).values, extractor.extract(speech).values)
    with pytest.raises(af.WeightsError, match="--weights"):
        af.extractor_from_spec(spec)
    with pytest.raises(af.FeatureError, match="'layers'"):
        af.extractor_from_spec({**spec, "layers": 2}, weights=network[0])
    write_wavlm(tmp_path / "other", seed=5)
    with pytest.raises(af.WeightsError) as caught:
        af.extractor_from_spec(spec, weights=tmp_path / "other")
    assert extractor.fingerprint in str(caught.value)
    assert af.WavLM(tmp_path / "other").fingerprint in str(caught.value)


def test_a_stack_puts_wavlm_on_the_acoustic_frames(network, speech):
    wavlm = af.WavLM(network[0])
    track = af.Stack([wavlm, af.Prosody()]).extract(speech)
    assert track.values.shape == (400, wavlm.dim + 4)
    alone = wavlm.extract(speech).at(track.times).values
    np.testing.assert_array_equal(track.values[:, : wavlm.dim], alone)


def test_nothing_is_printed_or_warned_about(network, speech, capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        af.WavLM(network[0]).extract(speech)
    assert capfd.readouterr() == ("", "")


# Presets, against DiffuseStyleGesture's pipelines, written down here as published.

functional = torch.nn.functional


@pytest.fixture(scope="module")
def large(tmp_path_factory, write_wavlm):
    folder = tmp_path_factory.mktemp("large")
    return folder, write_wavlm(folder, norm="layer")


def noise(seconds: float) -> np.ndarray:
    n = round(seconds * 16_000)
    return np.random.default_rng(0).normal(0.01, 0.1, n).astype(np.float32)


def stretched(features, size: int):
    """(1, T, D) to (size, D)."""
    how = {"align_corners": True, "mode": "linear"}
    return functional.interpolate(features.transpose(1, 2), size=size, **how)[0].T.numpy()


def test_dsg_extracts_clips_with_the_eight_frames_before_them(large):
    folder, model = large
    samples = noise(9.3)
    stride, seed = 64_000, 6_400  # 80 and 8 motion frames of 800 samples
    clips = [samples[at : at + stride] for at in (0, stride)]
    before = [np.zeros(seed, np.float32), clips[0][-seed:]]
    expected = []
    with torch.no_grad():
        for earlier, clip in zip(before, clips):
            heard = torch.from_numpy(np.concatenate([earlier, clip]))[None]  # not normalised
            expected.append(stretched(model(heard).last_hidden_state, 88)[8:])
    track = af.WavLM(folder, preset="dsg").extract(af.Wave(samples, 16_000))
    assert track.values.shape == (186, 32)  # they drop the 26 frames after the last whole clip
    np.testing.assert_allclose(track.values[:160], np.concatenate(expected), atol=1e-4)
    np.testing.assert_allclose(track.times, np.arange(186) / 20)
    assert len(af.WavLM(folder, preset="dsg").extract(af.Wave(samples[:400], 16_000)).times) == 1


@pytest.mark.parametrize("seconds", [5.0, 12.1])
def test_dsg_plus_squeezes_its_padding_into_the_sound(large, seconds):
    folder, model = large
    samples = noise(seconds)
    sound = torch.from_numpy(samples)
    sound = functional.layer_norm(sound, sound.shape)
    pieces = len(sound) // 80_000 + 1
    sound = functional.pad(sound, (0, pieces * 80_000 - len(sound))).reshape(pieces, 80_000)
    with torch.no_grad():
        features = model(sound).last_hidden_state
    size = round(seconds * 30)
    expected = stretched(features.reshape(1, -1, 32), size)
    # The folder is Hugging Face's, whose own eps is 1e-7; theirs is 1e-5 whatever the file says.
    track = af.WavLM(folder, preset="dsg+").extract(af.Wave(samples, 16_000))
    np.testing.assert_allclose(track.values, expected, atol=1e-4)
    np.testing.assert_allclose(track.times, np.arange(size) / 30)
