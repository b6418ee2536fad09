"""Streams of a model whose network is given a drawn state of movement."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from small_runs import small_config
from streams import streamed

import audio_features as af
import gesturekit as gk
from gesturekit.corpus import Manifest
from gesturekit.errors import ModelError
from gesturekit.multires import MultiresGenerator, train
from gesturekit.multires.sampling.trained_model import Pyramid, clocked_noise
from gesturekit.multires.streaming.levels import WindowLevels
from gesturekit.multires.streaming.live_state import LiveState
from gesturekit.multires.streaming.plan import Forecast, LiveChoice

RATE = 16_000
SETTINGS = {
    "state": True,
    "features": {"extractors": [{"kind": "prosody"}, {"kind": "effort", "seconds": 2.0}]},
    "losses": {"state": 100.0, "arm_speed": 0.0},
}


@pytest.fixture(scope="module")
def model(corpus, tmp_path_factory):
    return gk.load(train(small_config(corpus, tmp_path_factory.mktemp("live") / "run", SETTINGS)))


@pytest.fixture(scope="module")
def speech(corpus) -> np.ndarray:
    """Three seconds of sound; speech begins after half a second."""
    first = next(iter(Manifest.load(corpus)))
    wave = af.Wave.load(first.audio).resample(RATE)
    return np.concatenate([np.zeros(RATE // 2, np.float32), wave.samples[: 5 * RATE // 2]])


def test_a_stream_does_not_depend_on_blocks_or_on_what_is_said_later(model, speech):
    usual = streamed(model.stream(RATE, seed=3), speech)
    assert usual.n_frames == round(len(speech) / RATE * model.fps)
    again = streamed(model.stream(RATE, seed=3), speech, itertools.cycle((1, 977, 5000)))
    np.testing.assert_array_equal(usual.rotations, again.rotations)
    changed = speech.copy()
    changed[2 * RATE :] = 0.0
    other = streamed(model.stream(RATE, seed=3), changed)
    frames = int((2 - 0.2) * model.fps)
    np.testing.assert_array_equal(usual.rotations[:frames], other.rotations[:frames])
    assert not np.array_equal(usual.rotations, other.rotations)


def test_what_is_to_come_is_not_predicted(model):
    """The forecast counts up to its last time, as far as it is known; noise does the rest."""
    fast, around = model.state_process.channels.fast, 40
    process = replace(model.state_process, explained=np.where(fast, 0.6, 0.0))
    speech = np.zeros((2 * around, model.conditions.conditioner.dim))

    def drawn(value: float, share: float) -> np.ndarray:
        own = LiveState(process, LiveChoice(seed=1), around)
        times, known = np.array([0.0, 0.2]), np.array([1.0, share])
        return own.advance(speech, Forecast(times, known * value, 0.4, known), 0.0)[: len(fast)][
            fast
        ]

    higher, usual = drawn(9.0, 0.5), drawn(0.0, 0.5)
    assert (higher[:, around] > usual[:, around]).all()
    np.testing.assert_array_equal(higher[:, around + 6 :], usual[:, around + 6 :])
    assert not np.array_equal(drawn(9.0, 0.1)[:, around + 3], higher[:, around + 3])


def test_a_stream_goes_on_from_its_state(model, speech):
    one, other = model.stream(RATE, seed=3), model.stream(RATE, seed=3)
    one.step(speech[:RATE])
    kept = one.state()
    first = one.step(speech[RATE:])
    other.restore(kept)
    np.testing.assert_array_equal(first.rotations, other.step(speech[RATE:]).rotations)


def test_a_stream_draws_its_state(model):
    with pytest.raises(ModelError, match="state"):
        model.stream(RATE, state=np.zeros((9, 12)))


def test_seed_mood_and_liveliness_decide_what_is_shown(model, speech):
    def of(**options) -> np.ndarray:
        return streamed(model.stream(RATE, **options), speech).rotations

    usual = of(seed=3)
    np.testing.assert_array_equal(usual, of(seed=3, mood_seed=3))
    for options in ({"seed": 4}, {"seed": 3, "mood_seed": 4}, {"seed": 3, "liveliness": 2.0}):
        assert not np.array_equal(usual, of(**options)), options


@pytest.mark.parametrize("residual", [False, True])
@pytest.mark.parametrize("part", [range(0, 3), range(20, 24), range(61, 64)])
def test_levels_of_a_frame_are_those_of_the_whole_window(model, residual, part):
    """Some of 64 frames, as sampling makes them, with two styles."""
    torch.manual_seed(0)
    config, rng = model.network_config, np.random.default_rng(0)
    conditions = replace(model.conditions, styles=("a", "b"), residual=residual)
    network = MultiresGenerator(model.representation, conditions.width, config).eval()
    for film in (film for level in network.levels for film in level.films):
        torch.nn.init.normal_(film.gain.weight, std=0.3)
        torch.nn.init.normal_(film.shift.bias, std=0.3)
    own = replace(model, network=network, conditions=conditions)
    lengths = af.level_lengths(64, config.levels)
    styles = [torch.tensor([[0.25], [0.75]]).expand(1, 2, n) for n in lengths]
    speech = rng.standard_normal((64, conditions.conditioner.dim)).astype(np.float32)
    state = rng.standard_normal((conditions.state.width, 64)).astype(np.float32)
    condition = conditions.of_motion(speech, lengths, styles, (), state)
    sigma = model.noise.sigma.mean(dim=0)[0]
    noise = clocked_noise(state[None], conditions.state.n_carriers, lengths[0], sigma)
    whole = Pyramid(own, lengths, condition).from_noise(noise)
    found = WindowLevels(own, lengths, styles, part)(speech, state=state)
    found = own.normaliser.to_values(found[None])
    np.testing.assert_allclose(found, whole[part.start : part.stop], atol=1e-5)
    assert np.abs(whole[20:24] - whole[24:28]).max() > 0.02, "the test can tell frames apart"
