"""Streams of the bundled model: what they promise about time, blocks, the future and the body."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import stats
from small_models import small_diffusion

import audio_features as af
import gesturekit as gk
from gesturekit.errors import ModelError
from gesturekit.motion.concatenation import stacked
from gesturekit.multires.constraints.keyframes import moved
from gesturekit.multires.network.generator import MultiresGenerator
from gesturekit.multires.recall.ahead import AheadPrediction, FeatureWindow, last_bins
from gesturekit.multires.recall.pieces import ChoiceWeights, PieceSearch
from gesturekit.multires.recall.slow_state import SlowState
from gesturekit.multires.sampling.trained_model import Pyramid, RandomNoise
from gesturekit.multires.streaming.features import SpeechStream
from gesturekit.multires.streaming.feet import FootHold
from gesturekit.multires.streaming.levels import FinerLevels
from gesturekit.multires.streaming.plan import Forecast, LiveChoice, LivePlan

RATE = 16_000


@pytest.fixture(scope="module")
def model():
    return gk.load("demo")


@pytest.fixture(scope="module")
def speech() -> np.ndarray:
    """Three seconds of sound; speech begins after half a second."""
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    sound = wave.resample(RATE).samples[: 5 * RATE // 2]
    return np.concatenate([np.zeros(RATE // 2, np.float32), sound])


def streamed(stream, samples: np.ndarray, sizes=itertools.repeat(640)) -> gk.Motion:  # noqa: B008
    """The motion of samples in blocks of these sizes, to the end of the stream."""
    made, first = [], 0
    for size in sizes:
        made.append(stream.step(samples[first : first + size]))
        first += size
        if first >= len(samples):
            break
    return stacked([part for part in [*made, stream.finish()] if part is not None])


@pytest.fixture(scope="module")
def usual(model, speech) -> gk.Motion:
    return streamed(model.stream(RATE, seed=3), speech)


def equal(first: gk.Motion, second: gk.Motion, frames: slice = slice(None)) -> bool:
    return np.array_equal(first.rotations[frames], second.rotations[frames]) and np.array_equal(
        first.translation[frames], second.translation[frames]
    )


# Time.


@pytest.mark.parametrize("samples, frames", [(0, 0), (266, 0), (267, 1), (16_000, 30), (1, 0)])
def test_a_stream_has_as_many_frames_as_a_file(model, samples, frames):
    """floor(duration · fps + 1/2), at 30 fps: 266 samples are 0.499 frames, 267 are 0.501."""
    stream = model.stream(RATE)
    parts = [stream.step(np.zeros(samples, np.float32)), stream.finish()]
    assert sum(part.n_frames for part in parts if part is not None) == stream.n_frames == frames


@pytest.mark.parametrize("look_ahead", [0.0, 0.2, 0.4])
def test_a_frame_comes_after_its_latency_and_no_later(model, speech, look_ahead):
    stream = model.stream(RATE, look_ahead)
    assert stream.latency <= look_ahead + 0.011, "samples are taken 10 ms at a time"
    given = 0
    for block in np.split(speech[:RATE], 100):
        stream.step(block)
        given += len(block)
        due = given / RATE - stream.latency
        assert stream.n_frames >= np.floor(due * model.fps - 1e-6) or due < 0.1
        assert stream.n_frames <= max(0, np.ceil((due + 0.1) * model.fps)) + 1


def test_the_size_of_blocks_changes_no_bit_and_a_stream_equals_its_replay(model, speech, usual):
    rng = np.random.default_rng(0)
    odd = (int(rng.integers(0, 3000)) for _ in itertools.count())
    for sizes in (odd, itertools.repeat(48_000)):
        assert equal(streamed(model.stream(RATE, seed=3), speech, sizes), usual)
    short = speech[RATE : RATE + 3000]
    single = streamed(model.stream(RATE, seed=3), short, itertools.repeat(1))
    assert equal(streamed(model.stream(RATE, seed=3), short), single)
    for options in ({"seed": 4}, {"item": "b"}):
        other = streamed(model.stream(RATE, **{"seed": 3} | options), speech[: 2 * RATE])
        assert not equal(other, usual, slice(0, 50))


def test_sound_beyond_the_look_ahead_has_no_influence(model, speech, usual):
    changed = speech.copy()
    changed[2 * RATE :] = np.random.default_rng(1).normal(0, 0.2, RATE)
    other = streamed(model.stream(RATE, seed=3), changed)
    before = slice(0, int((2.0 - 0.2) * model.fps))
    assert equal(other, usual, before) and not equal(other, usual)


def test_a_stream_goes_on_from_its_state(model, speech, usual):
    first = model.stream(RATE, seed=3)
    begun = first.step(speech[: RATE + 123])
    kept = first.state()
    first.step(speech[: RATE // 2])
    second = model.stream(RATE, seed=3)
    second.restore(kept)
    rest = [second.step(speech[RATE + 123 :]), second.finish()]
    assert equal(stacked([begun, *rest]), usual)


# Motion.


def arms(motion: gk.Motion) -> np.ndarray:
    """Mean speed (T - 1,) of both hands relative to the hips, m/s."""
    names, places = motion.skeleton.names, motion.positions()
    hands = places[:, [names.index("LeftHand"), names.index("RightHand")]] - places[:, :1]
    return np.linalg.norm(np.diff(hands, axis=0), axis=-1).mean(axis=1) * motion.fps


def test_hands_move_with_the_speech_and_calm_down_after_it(model):
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    seconds = 9
    sound = wave.resample(RATE).samples[: seconds * RATE]
    sound = np.concatenate([sound, np.zeros(6 * RATE, np.float32)])
    speed = arms(streamed(model.stream(RATE, seed=1), sound, itertools.repeat(RATE)))
    spoken, after = speed[30 : 30 * seconds], speed[-90:]
    loudness = np.log(wave.rms(np.arange(30, 30 * seconds) / 30, 0.3) + 1e-3)
    assert stats.spearmanr(spoken, loudness).statistic > 0.15
    assert np.median(spoken) > 2.0 * np.median(after)
    assert np.median(after) > 0.002, "idle, not frozen"


def test_a_quiet_microphone_gives_the_same_motion(model, speech, usual):
    quiet = streamed(model.stream(RATE, seed=3), 0.1 * speech[: 2 * RATE])
    turn = np.abs((quiet.rotations * usual.rotations[:60]).sum(axis=-1)).clip(0, 1)
    assert np.degrees(2 * np.arccos(turn)).mean() < 0.5


def test_noise_without_voice_moves_as_silence_does(model):
    silent = streamed(model.stream(RATE), np.zeros(RATE, np.float32))
    noise = np.random.default_rng(0).normal(0, 0.05, RATE).astype(np.float32)
    assert equal(streamed(model.stream(RATE), noise), silent)


def test_frames_join_without_jumps(model, usual):
    """No joint turns faster from one frame to the next than in the model's own recordings."""
    turn = np.abs((usual.rotations[1:] * usual.rotations[:-1]).sum(axis=-1)).clip(0, 1)
    fastest = np.degrees(2 * np.arccos(turn)).max() * model.fps
    assert fastest < 900
    hips = np.linalg.norm(np.diff(usual.translation, axis=0), axis=1) * model.fps
    assert hips.max() < 0.5
    assert np.abs(usual.translation[:, [0, 2]]).max() < 0.3


def test_liveliness_and_fingers(model, speech):
    short = speech[: 2 * RATE]
    lively = streamed(model.stream(RATE, liveliness=2.0), short)
    calm = streamed(model.stream(RATE, liveliness=0.4, foot_lock=False), short)
    assert np.median(arms(lively)) > np.median(arms(calm))
    fingers = [i for i, name in enumerate(model.skeleton.names) if name.endswith(("1", "2", "3"))]
    assert np.ptp(lively.rotations[:, fingers], axis=0).max() > 0.01, "fingers are recalled too"


def test_what_cannot_stream_says_why(model, gesture):
    no_ahead = replace(model, library=replace(model.library, ahead=()))
    no_recall = replace(model, library=None)
    conditioner = replace(model.conditions.conditioner, extractor=af.Music())
    music = replace(model, conditions=replace(model.conditions, conditioner=conditioner))
    for own, options, message in (
        (no_ahead, {}, "no predictions for live speech: gesturekit live --fit corpus.jsonl"),
        (no_recall, {}, "without recall cannot stream"),
        (music, {}, "cannot stream: music: these features need the whole sound"),
        (small_diffusion(gesture), {}, "a diffusion model generates whole motions only: multires"),
        (model, {"look_ahead": -0.1}, "look_ahead=-0.1: seconds from 0"),
        (model, {"levels": 3}, "levels: a stream takes style, .*smooth only"),
        (model, {"style": "old"}, "style='old': this multires model has no style"),
    ):
        with pytest.raises(ModelError, match=message):
            own.stream(RATE, **options)
    with pytest.raises(ModelError, match=r"shape \(2, 3\): a stream takes finite samples \(N,\)"):
        model.stream(RATE).step(np.zeros((2, 3)))
    with pytest.raises(ModelError, match="finite"):
        model.stream(RATE).step(np.array([np.nan]))


# Parts.


@pytest.mark.parametrize(
    "film, residual, backend", [("all", False, "auto"), ("input", True, "torch")]
)
def test_finer_levels_of_a_frame_are_those_of_the_whole_window(
    model, film, residual, backend, monkeypatch
):
    """Frames 20 to 23 of 64, as sampling without noise makes them, with two styles."""
    monkeypatch.setenv("GESTUREKIT_BACKEND", backend)
    torch.manual_seed(0)
    config = replace(model.network_config, film=film, rectify_embedding=not residual)
    conditions = replace(model.conditions, styles=("a", "b"), residual=residual)
    network = MultiresGenerator(model.representation, conditions.width, config).eval()
    for level in network.levels:
        for own in level.films:
            torch.nn.init.normal_(own.gain.weight, std=0.3)
            torch.nn.init.normal_(own.shift.bias, std=0.3)
    own = replace(model, network=network, conditions=conditions)
    lengths = af.level_lengths(64, config.levels)
    styles = [torch.tensor([[0.25], [0.75]]).expand(1, 2, n) for n in lengths]
    speech = np.random.default_rng(0).standard_normal((64, model.conditions.conditioner.dim))
    speech = speech.astype(np.float32)
    level = model.library.level - 1
    recalled = torch.randn(1, model.representation.n_features, lengths[level])
    condition = conditions.of_motion(speech, lengths, styles)
    quiet = RandomNoise(torch.zeros(0), 0, None)
    whole = Pyramid(own, lengths, condition, quiet, None, recalled, level).random()
    finer = FinerLevels(own, lengths, styles, range(20, 24))
    used = recalled[0, :, finer.recalled.start : finer.recalled.stop]
    found = own.normaliser.to_values(finer(used, speech)[None])
    np.testing.assert_allclose(found, whole[20:24], atol=1e-4)
    assert np.abs(whole[20:24] - whole[24:28]).max() > 0.1, "the test can tell frames apart"


def test_slow_noise_without_end_is_distributed_and_smooth_as_drawn_noise():
    """Standard normal at any time, correlated between channels and over four seconds."""
    mixing = np.linalg.cholesky(np.array([[1.0, 0.6], [0.6, 1.0]]))
    state = SlowState(
        np.array([0.8, 0.0]), 1.0, mixing, np.array([0.3, 0.3]), np.array([2.0, 3.0]), 30.0
    )
    times = np.arange(0, 6000, 10.0)
    found = np.concatenate([state.at(5, t, None) for t in times], axis=1)
    assert found.std(axis=1) == pytest.approx(1.0, abs=0.12)
    assert np.corrcoef(found)[0, 1] == pytest.approx(0.6, abs=0.12)
    later = np.concatenate([state.at(5, t + 4.0, None) for t in times], axis=1)
    # exp(-t^2 / (4 width^2)) within takes, and the whole of the noise between takes
    expected = 0.7 * np.exp(-(4.0**2) / (4 * 2.0**2)) + 0.3
    assert np.corrcoef(found[0], later[0])[0, 1] == pytest.approx(expected, abs=0.1)
    noise = state.at(5, 12.0, None)
    predicted = state.at(5, 12.0, 2.0)
    assert predicted[0] == pytest.approx(0.8 * 2.0 + 0.6 * noise[0])
    assert predicted[1] == pytest.approx(noise[1])
    assert not np.array_equal(state.at(6, 12.0, None), noise)


def test_the_next_piece_fits_what_is_wanted_and_goes_on_where_nothing_is():
    rng = np.random.default_rng(0)
    vectors = [rng.standard_normal((40, 3)), rng.standard_normal((30, 3))]
    profiles = [rng.standard_normal((40, 1)), rng.standard_normal((30, 1))]
    states = [np.zeros((40, 1)), np.zeros((30, 1))]
    fine = [np.zeros(40, bool), np.zeros(30, bool)]

    def search(**weights) -> PieceSearch:
        own = ChoiceWeights(**{"used": 0.0, "chance": 0.0, "continuity": 0.0} | weights)
        return PieceSearch(vectors, profiles, states, 6, 2, [1.0], own, fine)

    def chosen(of: PieceSearch, wanted, used=None, **options) -> tuple[int, int]:
        used = np.zeros(of.n_bins) if used is None else used
        generator = torch.Generator().manual_seed(0)
        best = of.following(generator, wanted, np.zeros(1), used, **options)
        return int(of.recording[best]), int(of.start[best])

    wanted = profiles[1][7:13]
    assert chosen(search(), wanted) == (1, 7)
    begun = wanted.copy()
    begun[3:] = np.nan
    assert chosen(search(), begun) == (1, 7), "unknown frames match anything"
    assert chosen(search(), wanted, allowed=np.array([True, False]))[0] == 0
    nothing = np.full((6, 1), np.nan)
    assert chosen(search(continuity=1.0), nothing, shown=40 + 11) == (1, 11), "it goes on"
    held = chosen(search(continuity=1.0), nothing, shown=69)
    ends = [vectors[k][s : s + 2] for k, n in ((0, 35), (1, 25)) for s in range(n)]
    nearest = np.argmin([np.square(end - vectors[1][-1]).sum() for end in ends])
    assert held == ((0, nearest) if nearest < 35 else (1, nearest - 35)), "the last frame is held"
    used = np.zeros(search().n_bins)
    assert chosen(search(), wanted, used) == (1, 7)
    assert used.sum() == pytest.approx(1.0)
    assert chosen(search(used=1e6), wanted, used) != (1, 7), "not the same piece again"
    elsewhere = np.arange(47, 53)[:, None]
    assert chosen(search(copied=1e6), wanted, others=elsewhere) != (1, 7)


def test_a_forecast_holds_a_while():
    """Linear between the known times, and the last value for 0.6 s more."""
    forecast = Forecast(np.array([0.0, 0.1, 0.2]), np.array([1.0, 3.0, 2.0]), 0.4)
    found = forecast.at(np.array([0.0, 0.05, 0.15, 0.2, 0.79, 0.81, 2.0]))
    np.testing.assert_allclose(found, [1.0, 2.0, 2.5, 2.0, 2.0, np.nan, np.nan])


def test_the_newest_sound_says_most_about_now_and_less_about_what_follows(
    model, speech, monkeypatch
):
    """A look-ahead of 0.2 s gives a prediction for now, one for 0.1 s later and one for 0.2 s."""
    forecasts = []
    advance = LivePlan.advance

    def kept(self, fast, slow):
        forecasts.append(fast)
        advance(self, fast, slow)

    monkeypatch.setattr(LivePlan, "advance", kept)
    streamed(model.stream(RATE, 0.2), speech[:RATE])
    assert len(forecasts) == 30
    for forecast in forecasts:
        np.testing.assert_allclose(forecast.seconds, [0, 0.1, 0.2], atol=0.5 / 30)
        assert [forecast.r] == [p.fast.r for p in model.library.ahead if p.look_ahead == 0.2]


def test_a_standing_foot_stays_and_a_lifted_one_returns(model, usual):
    """The body slides by 1 mm a frame; both feet stand, then one is lifted."""
    representation = model.representation
    pose = usual[40:41]
    hold = FootHold(model.skeleton, 30.0)
    names = model.skeleton.names
    feet = [names.index("LeftFoot"), names.index("RightFoot")]
    points = len(representation.foot_points)
    left = np.array(["Left" in point.joint for point in representation.foot_points])
    made, free = [], []
    for t in range(90):
        slid = moved(representation, pose, np.array([0.001 * t, 0.0]))
        contacts = np.where(left & (t >= 60), 0.0, np.ones(points))
        made.append(hold(slid, contacts, lambda m, by: moved(representation, m, by)))
        free.append(slid)
    found = stacked(made).positions()[:, feet, 0]
    own = stacked(free).positions()[:, feet, 0]
    assert np.abs(np.diff(found[1:60], axis=0)).max() < 2e-4, "standing feet hardly slide"
    assert np.ptp(own[:60, 0]) == pytest.approx(0.059, abs=1e-6)
    assert np.abs(np.diff(found[61:, 1])).max() < 2e-4
    # The lifted one follows the body again: the slide of both, less what the body was held back.
    assert found[-1, 0] - found[60, 0] < own[-1, 0] - own[60, 0]
    body = stacked(made).translation[:, 0]
    assert body[59] - body[0] < 0.03, "the body stays over its feet"


def test_a_body_without_legs_is_left_alone(model, usual):
    torso = usual.keep(
        [n for n in usual.skeleton.names if "Leg" not in n and "Foot" not in n and "Toe" not in n]
    )[:1]
    assert FootHold(torso.skeleton, 30.0)(torso, np.ones(0), lambda m, by: m) is torso


@pytest.fixture(scope="module")
def ramps(model):
    """The demo's library with recordings whose every channel counts 1000 times k, plus frames."""
    library = model.library
    recordings = []
    for k, recording in enumerate(library.recordings):
        n_frames = recording.motion.shape[-1]
        ramp = 1000.0 * k + torch.arange(n_frames, dtype=torch.float32)
        profiles = torch.zeros_like(recording.profiles)
        own = {"motion": ramp.expand(recording.motion.shape), "profiles": profiles}
        recordings.append(replace(recording, **own))
    return replace(library, recordings=tuple(recordings))


def shown(plan: LivePlan, part: int, *offsets: float) -> np.ndarray:
    """Return what a part of a plan on `ramps` shows at frames relative to the current one."""
    columns = plan.library.parts[part].columns
    return plan.vectors(np.array(offsets))[:, columns[0]]


def test_pieces_play_fade_and_go_on_in_real_time(ramps):
    """One level frame is 30 / 5.34 motion frames; fades take 2 of an arm's pieces of 5."""
    plan = LivePlan(ramps, LiveChoice(), past=12)
    step, frame = ramps.level_fps / ramps.fps, 60
    fade = 2
    # Arms ran twice as fast as recorded, for the last 12 frames.
    clock = 5.0 + 2 * step * np.arange(-12, 1.0)
    now, begin = frame * step, 60 * step - 6 * step
    arm = [(0.0, 0.0, 0, 3.0), (begin, 5.0 - 12 * step, 1, 7.0)]
    rest = [(0.0, 0.0, 2, 0.0), (now - fade - 0.5, now - fade - 0.5, 3, 10.0)]
    plan.restore(plan.state() | {"_frame": frame, "_clock": clock, "_pieces": [arm, arm, rest]})
    # Six frames into the fade the arm is 12 frames of the level's rate into its new piece.
    part = 6 * step / fade
    weight = part**3 * (10 - 15 * part + 6 * part**2)
    expected = weight * (1007 + 12 * step) + (1 - weight) * (3.0 + 5.0)
    assert shown(plan, 0, 0.0)[0] == pytest.approx(expected, rel=1e-4)
    # Before its begin, the piece before; long after, the new one, which goes on as recorded.
    assert shown(plan, 0, -8.0)[0] == pytest.approx(3.0 + 5.0 - 16 * step, rel=1e-4)
    late = 11.0
    assert shown(plan, 0, late)[0] == pytest.approx(1007 + (12 + late) * step, rel=1e-4)
    # The trunk has no tempo, and longer pieces.
    longer = 5
    part = (fade + 0.5) / longer
    weight = min(1.0, part**3 * (10 - 15 * part + 6 * part**2))
    expected = weight * (3010 + fade + 0.5) + (1 - weight) * (2000 + now)
    assert shown(plan, 2, 0.0)[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("wanted, tempo", [(0.0, 1.0), (0.3, np.exp(0.3 / 0.5)), (9.0, 3.0)])
def test_arms_run_as_fast_as_speech_predicts(ramps, wanted, tempo):
    """Pieces of mean movement: log m/s wanted, divided by its correlation; at most three times."""
    plan = LivePlan(ramps, LiveChoice(), past=12)
    forecast = Forecast(np.zeros(1), np.full(1, wanted), 0.5)
    clocks = []
    for _ in range(30):
        plan.advance(forecast, 0.0)
        clocks.append(plan.state()["_clock"][-1])
    step = ramps.level_fps / ramps.fps
    assert clocks[0] == 0.0
    assert np.diff(clocks)[-5:] == pytest.approx(tempo * step, rel=1e-3)
    # Within 50 ms it is most of the way there.
    assert (np.log(np.diff(clocks)[1] / step)) == pytest.approx(
        np.log(tempo) * (1 - np.exp(-2 / 30 / 0.05)), abs=1e-6
    )
    quiet = Forecast(np.zeros(1), np.full(1, -9.0), 0.5)
    for _ in range(30):
        plan.advance(quiet, 0.0)
    clock = plan.state()["_clock"]
    assert clock[-1] - clock[-2] == pytest.approx(step / 3, rel=1e-3)


def test_a_voice_that_always_sounds_lively_is_not_lively_throughout(ramps):
    """The mean prediction counts by `mean_counts`, from a mean of 0 that weighs 5 s."""
    asked = []

    class Recorded(SlowState):
        def at(self, seed, seconds, predicted):
            asked.append((seconds, predicted))
            return super().at(seed, seconds, predicted)

    own = ramps.slow_state
    fields = {name: getattr(own, name) for name in own.__dataclass_fields__}
    plan = LivePlan(replace(ramps, slow_state=Recorded(**fields)), LiveChoice(), 12)
    for _ in range(301):
        plan.advance(None, 2.0)
    for seconds, predicted in asked[1:]:
        n = 30 * seconds + 1
        mean = 2.0 * n / (n + 150)
        assert predicted == pytest.approx(2.0 - (1 - ramps.wanted.mean_counts) * mean)
    assert len(asked) > 15, "pieces are chosen every half second"


def test_the_slow_noise_between_takes_lasts_as_long_as_takes():
    """Alone, its correlation is that of noise smoothed by a Gaussian as long as a take."""
    state = SlowState(np.zeros(1), 0.0, np.eye(1), np.ones(1), np.array([2.0]), 40.0)
    times = np.arange(0, 30_000, 90.0)
    found, later = (
        np.array([state.at(3, t + lag, None)[0, 0] for t in times]) for lag in (0.0, 30.0)
    )
    assert found.std() == pytest.approx(1.0, abs=0.12)
    assert np.corrcoef(found, later)[0, 1] == pytest.approx(
        np.exp(-(30.0**2) / (4 * 40.0**2)), abs=0.06
    )


def test_features_of_a_stream_are_those_of_the_file_where_both_know_as_much(model):
    """Level, pitch and mean of a voice are the same after some seconds of it."""
    conditioner = model.conditions.conditioner
    wave = af.Wave.load(Path(gk.__file__).parent / "models" / "demo" / "speech.wav")
    whole = conditioner(wave)
    stream = SpeechStream(conditioner, wave.sample_rate, rows=40)
    windows = list(stream.push(wave.samples))
    assert stream.n_rows == len(windows) == pytest.approx(len(whole), abs=3)
    last = np.stack([one.rows[-1] for one in windows])[150:]
    names = list(conditioner.extractor.names)
    for name in ("mel_3", "mel_12", "voicing", "energy", "onset"):
        column = names.index(name)
        r = np.corrcoef(last[:, column], whole[150 : len(windows), column])[0, 1]
        assert r > 0.9, name
        assert abs(np.mean(last[:, column] - whole[150 : len(windows), column])) < 0.6, name
    # The window before goes on from row to row, and begins with silence.
    assert np.abs(windows[200].rows[-2] - windows[199].rows[-1]).mean() < 0.2
    np.testing.assert_array_equal(
        windows[9].rows[:30], np.repeat(conditioner.silence(1), 30, axis=0)
    )
    # Running means over 2 and 8 s.
    slow = conditioner.silence(1)[0].astype(float)
    for row in [one.rows[-1] for one in windows]:
        slow += (row - slow) / (2.0 * model.fps)
    np.testing.assert_allclose(windows[-1].averages[0], slow)


def test_a_second_without_speech_is_a_pause(model, speech):
    """The first word is spoken after 1.1 s, the last one until 3 s."""
    stream = SpeechStream(model.conditions.conditioner, RATE, rows=4)
    sound = np.concatenate([speech, np.zeros(2 * RATE, np.float32)])
    paused = np.array([window.paused for window in stream.push(sound)])
    assert paused[: round(1.0 * model.fps)].all() and paused[round(4.1 * model.fps) :].all()
    assert not paused[round(1.3 * model.fps) : round(3.9 * model.fps)].any()


def test_a_row_is_complete_with_the_last_frame_that_it_needs(model):
    """Row 0 of 30 fps takes frames 0 and 10 ms, which need 32 ms more; samples come by 10 ms."""
    stream = SpeechStream(model.conditions.conditioner, RATE, rows=4)
    assert not list(stream.push(np.zeros(799, np.float32)))
    assert len(list(stream.push(np.zeros(1, np.float32)))) == 1
    assert stream.reach == pytest.approx(0.5 / 30 + 0.032 + 0.01)
    assert stream.rows_ahead(0.2) == 4, "(0.2 - 0.0587) * 30 = 4.2"
    assert stream.rows_ahead(0.0) == -2


def test_inputs_of_predictions_are_means_of_bins_that_end_now():
    """At 12.5 fps a bin of 0.16 s has two rows: four bins, relative to the running mean."""
    rows = np.arange(20.0).reshape(10, 2)  # rows [0, 1], [2, 3], ... [18, 19]
    speech = FeatureWindow(rows, np.array([[1.0, 2.0], [50.0, 60.0]]))
    expected = [[1, 2], [5 - 1, 6 - 2], [9 - 1, 10 - 2], [13 - 1, 14 - 2], [17 - 1, 18 - 2]]
    np.testing.assert_allclose(last_bins(speech, 12.5), expected)
    # Half a row of a slow model rounds to one.
    one = [[1, 2], [12 - 1, 13 - 2], [14 - 1, 15 - 2], [16 - 1, 17 - 2], [18 - 1, 19 - 2]]
    np.testing.assert_allclose(last_bins(speech, 3.0), one)


def test_predictions_ahead_find_what_speech_says(model):
    """Movement is twice the last bin of column 1; a calm voice is column 0's mean over 8 s."""
    wanted = replace(model.library.wanted, effort=(), fps=12.5)

    def recording(seed: int):
        own = np.random.default_rng(seed)
        speeches, fast, slow = [], [], []
        for _ in range(150):
            rows, averages = own.standard_normal((10, 3)), own.standard_normal((2, 3))
            speeches.append(FeatureWindow(rows, averages))
            fast.append(2 * rows[-2:, 1].mean() + 0.1 * own.standard_normal())
            slow.append(averages[1, 0] + 0.1 * own.standard_normal())
        return speeches, np.array(fast), np.array(slow)

    speeches, fast, slow = zip(*(recording(seed) for seed in range(3)), strict=True)
    fitted = AheadPrediction.fit(0.2, speeches, fast, slow, "abc", wanted, [(0, 1, 2), (1,)], 5.0)
    assert fitted.fast_columns.tolist() == [1], "fewer columns that predict as well"
    assert fitted.slow_columns.tolist() == [0, 1, 2], "one that does not know it is not used"
    assert fitted.fast.r > 0.95 and fitted.slow.r > 0.95
    unseen, true_fast, true_slow = recording(9)
    found = np.array([fitted(one, wanted) for one in unseen])
    assert np.corrcoef(found[:, 0], true_fast)[0, 1] > 0.9
    assert np.corrcoef(found[:, 1], true_slow)[0, 1] > 0.9
    # In a pause the body is as calm as two standard deviations below its mean, or calmer.
    paused = np.array([fitted(replace(one, paused=True), wanted)[1] for one in unseen])
    np.testing.assert_allclose(paused, np.minimum(found[:, 1], -2.0))
    # log m/s: never a larger share of movement than the whole sound predicts
    limited = replace(fitted, fast=replace(fitted.fast, r=0.5 * wanted.fast.r))
    half = np.array([limited(one, wanted)[0] for one in unseen])
    np.testing.assert_allclose(half, 0.5 * found[:, 0])
    assert np.abs(found[:, 0]).max() <= 2.5 * wanted.spread + 1e-9
