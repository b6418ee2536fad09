"""WavLM features: the values of transformers' own forward, whole and in chunks."""

import json
import os

import numpy as np
import pytest
from sounds import distance, swelling

import audio_features as af
from audio_features.speech_encoders import chunk_slices

torch = pytest.importorskip("torch")
transformers = pytest.importorskip("transformers")

pytestmark = pytest.mark.usefixtures("no_network")

# With GESTUREKIT_FULL_SIZE=1 the same comparison runs on networks of the published sizes.
FULL_SIZE = bool(os.environ.get("GESTUREKIT_FULL_SIZE"))
SECONDS = (0.1, 10.0, 60.0) if FULL_SIZE else (0.1, 2.0)


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


def test_transformers_own_network_agrees_in_chunks_too(network):
    wave = af.Wave(swelling(3.0), 16_000)
    long = {"full_context": 0.5, "chunk": 2.5, "context": 1.0}
    for settings, bound in (({"layer": [0, 2]}, 1e-5), (long, 0.05)):
        ours, theirs = (kind(network[0], **settings) for kind in (af.WavLM, af.HuggingFace))
        assert distance(ours.extract(wave).values, theirs.extract(wave).values) < bound
        assert ours.names == theirs.names


def test_inputs_of_the_transformer_are_exact_in_chunks(network):
    """Convolutions, normalisation over the whole sound, positions: no seam, no drift."""
    folder, model, large = network
    samples = swelling(4.3)
    state = of_transformers(model, samples, normalize=large)[1][0]
    for chunk, context in ((1.0, 0.2), (0.5, 0.0), (3.33, 0.5), (20.0, 2.0)):
        extractor = af.WavLM(folder, layer=0, full_context=1.0, chunk=chunk, context=context)
        assert distance(extractor.extract(af.Wave(samples, 16_000)).values, state) < 1e-5


def test_chunks_follow_each_other_and_see_their_context():
    rng = np.random.default_rng(0)
    for _ in range(100):
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


def test_bf16_is_close_and_changes_the_spec(network):
    wave = af.Wave(swelling(2.0), 16_000)
    exact, quick = (af.WavLM(network[0], dtype=dtype) for dtype in ("fp32", "bf16"))
    assert 1e-5 < distance(quick.extract(wave).values, exact.extract(wave).values) < 0.05
    assert quick.spec != exact.spec


def test_a_spec_requires_the_weights_of_its_fingerprint(network, tmp_path, speech, write_wavlm):
    extractor = af.WavLM(network[0], layer=2)
    odd = {"layer": {1: 1, 3: 2.5}, "final_norm": True, "dtype": "bf16", "normalize": 1e-5}
    for settings in (odd, {"full_context": 0.5, "chunk": 0.6, "context": 0.1}):
        first = af.WavLM(network[0], **settings)
        again = af.extractor_from_spec(json.loads(json.dumps(first.spec)), weights=network[0])
        assert again.spec == first.spec
        np.testing.assert_array_equal(again.extract(speech).values, first.extract(speech).values)
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
