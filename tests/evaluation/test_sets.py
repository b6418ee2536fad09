"""Metrics of the set of a model's clips, and of single clips, on motion made by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from rigs import without_joints

from gesturekit.corpus import Item
from gesturekit.evaluation.definitions import (
    DEFINITIONS,
    FRECHET,
    GROUPS,
    MOVEMENT,
    PATCHES,
    SIMILARITY,
    SPEECH,
    Variants,
)
from gesturekit.evaluation.measuring import set_metrics
from gesturekit.evaluation.measuring.clip_metrics import ClipMetrics
from gesturekit.evaluation.measuring.clips import Clip, RecordedSound
from gesturekit.evaluation.measuring.inputs import ReferenceStatistics, compute
from gesturekit.evaluation.measuring.pooled import PooledMetrics
from gesturekit.evaluation.measuring.samples import MotionSample
from gesturekit.evaluation.measuring.set_metrics import SetMetrics, speeds_of
from gesturekit.evaluation.measuring.speakers import TrainingMotion, backwards, own_windows
from gesturekit.evaluation.metrics.distributions import SpeedHistogram, hellinger
from gesturekit.evaluation.metrics.frechet.frechet import div_k, fid_k, raw_fgd
from gesturekit.evaluation.metrics.hands import (
    HAND_KEYS,
    calm_and_lively,
    hand_values,
    upper_joints,
)
from gesturekit.evaluation.metrics.patches import inter_diversity, patch_features
from gesturekit.evaluation.metrics.similarity import cca, pose_pair
from gesturekit.evaluation.metrics.sync import sync
from gesturekit.evaluation.metrics.two_sample import (
    forward_votes,
    motion_windows,
    nearest_training,
    two_sample_votes,
    within_reach,
)
from gesturekit.evaluation.pairs import ItemInterval, Pair
from gesturekit.motion import Motion
from gesturekit.motion.parts import body_joints


def clip_of(name: str, motion: Motion, recording: Motion, joints=None, audio=None) -> Clip:
    stem = name.partition("_")[0]
    pair = Pair(name, stem, None, Path("a"), Path("b"), audio)
    return Clip(pair, motion, recording, joints or body_joints(recording.skeleton), None, ())


def set_of(clips: list[Clip], *groups: str, **variants: str) -> SetMetrics:
    measure = SimpleNamespace(groups=groups, variants=Variants(**variants))
    found = SetMetrics(measure, 0, SimpleNamespace())
    for clip in clips:
        recorded = SpeedHistogram.of([speeds_of(clip.recording, clip.joints)])
        found.add(clip, recorded)
    return found


@pytest.fixture
def clips(gesture) -> list[Clip]:
    """Two samples of two recordings, of 3 s."""
    return [
        clip_of(f"{stem}_s{k}", gesture(3.0, 25.0, seed=10 * r + k), gesture(3.0, 25.0, seed=r))
        for r, stem in enumerate("ab")
        for k in (1, 2)
    ]


def test_speed_distributions_are_of_all_clips_and_what_is_beyond_is_named(clips):
    fast = replace(clips[3], generated=replace(clips[3].generated, fps=250.0))
    found = set_of([*clips[:3], fast]).pooled()
    speeds = [[speeds_of(side, c.joints) for c in (*clips[:3], fast)
               for side in [getattr(c, name)]] for name in ("generated", "recording")]  # fmt: skip
    result = found["hellinger"]
    assert set(found) == {"hellinger"}
    assert result.interval.value == pytest.approx(hellinger(*map(SpeedHistogram.of, speeds)))
    beyond = 100 * np.mean(np.concatenate(speeds[0]) > 0.49)
    assert result.note == f"{beyond:.1f} % beyond the last bin" and beyond > 5
    assert (result.interval.units, result.interval.n) == (2, 4)


def test_the_canonical_correlation_of_a_set_is_that_of_all_poses(clips, monkeypatch):
    result = set_of(clips, SIMILARITY).pooled()["cca_global"]
    both = [pose_pair(c.generated, c.recording, c.joints) for c in clips]
    expected = cca(*(np.concatenate(side) for side in zip(*both, strict=True)))
    assert result.interval.value == pytest.approx(expected, abs=1e-6) and result.interval.n == 4
    # Of clips on other joints than the first there are none; 300 poses are halved, and again.
    fewer = replace(clips[1], joints=clips[1].joints[:-1])
    assert set_of([clips[0], fewer], SIMILARITY).pooled()["cca_global"].interval.n == 1
    monkeypatch.setattr(set_metrics, "_CCA_FRAMES", 160)
    result = set_of(clips, SIMILARITY).pooled()["cca_global"]
    # At three clips every second pose is left of each, 114; the fourth has 38 more.
    thinned = [tuple(side[::2] for side in pair) for pair in both]
    expected = cca(*(np.concatenate(side) for side in zip(*thinned, strict=True)))
    assert result.interval.value == pytest.approx(expected, abs=1e-6)


def test_samples_of_a_recording_are_compared_up_to_twenty(clips, gesture):
    features = [patch_features(c.generated, joints=c.joints) for c in clips]
    found = set_of(clips, PATCHES).pooled()["inter_diversity"]
    each = [inter_diversity(features[:2]), inter_diversity(features[2:])]
    assert found.interval.value == pytest.approx(np.mean(each)) and found.interval.n == 2
    # On the joints of the clips alone.
    fewer = [replace(c, joints=c.joints[:-3]) for c in clips[:2]]
    features = [patch_features(c.generated, joints=c.joints) for c in fewer]
    value = set_of(fewer, PATCHES).pooled()["inter_diversity"].interval.value
    assert value == pytest.approx(inter_diversity(features)) != pytest.approx(each[0])
    measure = SimpleNamespace(groups=(PATCHES,), variants=Variants("paper"))
    paper = SetMetrics(measure, 0, SimpleNamespace())
    for c in clips[:2]:
        paper.add(c, SpeedHistogram())
    features = [patch_features(c.generated, "paper", joints=c.joints) for c in clips[:2]]
    value = paper.pooled()["inter_diversity"].interval.value
    assert value == pytest.approx(inter_diversity(features)) != pytest.approx(each[0])
    assert "inter_diversity" not in set_of(clips[::2], PATCHES).pooled(), "one sample each"
    many = [clip_of(f"a_s{k}", gesture(0.8, 25.0, seed=k), clips[0].recording) for k in range(22)]
    values = [set_of(many[:n], PATCHES).pooled()["inter_diversity"].interval.value
              for n in (19, 20, 22)]  # fmt: skip
    assert values[0] != values[1] == values[2]
    short = [clip_of(f"a_s{k}", gesture(0.3, 25.0), clips[0].recording) for k in range(2)]
    assert "inter_diversity" not in set_of(short, PATCHES).pooled()


def test_distances_of_sets_are_on_the_joints_that_all_clips_have(gesture):
    made = [gesture(25.0, 30.0, seed=k) for k in range(2)]
    recorded = [gesture(25.0, 30.0, seed=9 + k) for k in range(3)]
    joints = body_joints(made[0].skeleton)
    clips = [clip_of(f"c{k}", made[k], recorded[k], joints[k : len(joints) - 1 + k])
             for k in range(2)]  # fmt: skip
    shared = [name for name in joints[1:-1]]
    full, compared = MotionSample(0), MotionSample(0)
    for motion in recorded:
        full.add(motion)
    for motion in recorded[:2]:
        compared.add(motion)
    of_set = set_of(clips, FRECHET)
    found = of_set.frechet(full, compared, None)
    assert set(found) == {"raw_fgd", "fid_k", "fid_g", "div_k", "div_g"} and not of_set.problems
    for key, measure in (("raw_fgd", raw_fgd), ("fid_k", fid_k)):
        ours, own = (measure(one, recorded, joints=shared) for one in (made, recorded[:2]))
        assert found[key].interval.value == pytest.approx(ours.value), key
        assert found[key].recording == pytest.approx(own.value), key
    assert found["div_k"].interval.value == pytest.approx(div_k(made, recorded, joints=shared))
    assert found["div_k"].recording == pytest.approx(div_k(recorded[:2], recorded, joints=shared))
    assert found["div_k"].interval.n == 2
    whole = set_of(clips, FRECHET).frechet(full, None, None)
    assert whole["fid_k"].recording is None
    assert whole["div_k"].recording == pytest.approx(div_k(recorded, joints=shared))
    short = set_of([clip_of("c", made[0][:200], recorded[0])], FRECHET)
    few = short.frechet(full, None, None)
    released = set_of(clips, FRECHET, kinetic="released").frechet(full, None, None)
    for key, expected in (
        ("fid_k", fid_k(made, recorded, joints=shared, kinetic="released").value),
        ("div_k", div_k(made, recorded, joints=shared, kinetic="released")),
    ):
        assert released[key].interval.value == pytest.approx(expected), key
        assert whole[key].interval.value != pytest.approx(expected, rel=1e-3), key
    assert "fid_k" not in few and "raw_fgd" in few
    assert {key for key, _ in short.problems} == {"fid_k", "fid_g", "div_k", "div_g"}


def measured(groups=GROUPS, **more) -> ClipMetrics:
    return ClipMetrics(ReferenceStatistics(), groups, Variants(), **more)


def test_metrics_of_a_clip_are_those_of_the_groups(gesture):
    clip = clip_of("a", gesture(3.0, 25.0), gesture(3.0, 25.0, seed=1))
    for groups in ((MOVEMENT,), (PATCHES,), (SIMILARITY,), (MOVEMENT, SIMILARITY)):
        values, problems = measured(groups).generated(clip)
        keys = {key for key, d in DEFINITIONS.items() if d.taken_with in groups}
        assert values and set(values) <= keys and not problems
    cheap, _ = measured((MOVEMENT,), cheap=True).generated(clip)
    every, _ = measured((MOVEMENT,)).generated(clip)
    assert set(cheap) == {key for key in every if DEFINITIONS[key].cheap} < set(every)
    own, _ = measured((MOVEMENT, SIMILARITY)).recording(clip)
    assert {DEFINITIONS[key].of for key in own if DEFINITIONS[key].function} == {"motion"}
    assert own["arm_speed"] != every["arm_speed"]
    against = measured((MOVEMENT, SIMILARITY, PATCHES)).against(clip)
    assert {DEFINITIONS[key].of for key in against if DEFINITIONS[key].function} == {"comparison"}


def test_another_recording_in_place_of_the_own_one(gesture):
    clip = clip_of("a", gesture(3.0, 25.0), gesture(3.0, 25.0, seed=1))
    other = gesture(3.0, 25.0, seed=2)
    found = measured((SIMILARITY,)).mismatched_motion(clip, other)
    own = replace(clip, recording=other)
    assert found == {"cca": pytest.approx(measured((SIMILARITY,)).generated(own)[0]["cca"])}
    kept = [name for name in other.skeleton.names if name != "Neck"]
    assert measured((SIMILARITY,)).mismatched_motion(clip, other.keep(kept)) == {}


@pytest.fixture
def spoken(turning, speaking, curve, tmp_path):
    """A clip whose arms move with its sound, with the sound, and with the curve of its loudness."""
    loudness = curve(300, seed=0)
    wave = speaking(5.0 * loudness)
    motion = turning({"LeftForeArm": 4.0 * loudness})
    clip = clip_of("a", motion, motion)
    return clip, RecordedSound(wave), loudness


def test_timing_is_sync_above_chance_and_nothing_for_arms_that_hardly_move(
    spoken, turning, speaking, curve
):
    clip, sound, loudness = spoken
    metrics = measured((SPEECH,))
    found = metrics.mismatched_sound(clip, [sound])
    expected = sync(clip.generated, sound.wave)
    assert found["sync"] == pytest.approx(expected.r)
    assert found["sync_chance"] == pytest.approx(expected.chance_mean)
    assert found["sync_z"] == pytest.approx(expected.z)
    assert found["in_time"] == pytest.approx(expected.r - expected.chance_mean)
    # The mean over sounds.
    other = RecordedSound(speaking(5.0 * curve(300, seed=7)))
    both = metrics.mismatched_sound(clip, [sound, other])
    alone = metrics.mismatched_sound(clip, [other])
    assert both["sync"] == pytest.approx((found["sync"] + alone["sync"]) / 2)
    assert metrics.mismatched_sound(clip, []) == {}
    slow = replace(clip, generated=turning({"LeftForeArm": 0.1 * loudness}))
    found = metrics.mismatched_sound(slow, [sound])
    assert found["in_time"] == 0.0 and "sync" not in found
    # Too short for a chance level: no timing, but the correlation.
    short = replace(clip, generated=clip.generated[:40])
    found = metrics.mismatched_sound(short, [sound])
    assert "in_time" not in found and found["sync"] > 0.5 and found["sync_z"] == 0.0


def pooled_of(clips: list[Clip], training: TrainingMotion | None = None):
    """Return a set's pooled metrics, and those of each clip."""
    found = PooledMetrics(training or TrainingMotion(), 0)
    for clip in clips:
        found.add(clip)
    return found.pooled(), found.by_clip(), found.problems


@pytest.fixture(scope="module")
def by_speaker(gesture) -> dict[str, list[Clip]]:
    """Two samples of each of two takes of two speakers; of 10 to 12 s."""
    found = {}
    for s, name in enumerate(("ann", "ben")):
        for take in (1, 2):
            item = Item(id=f"{name}{take}", audio=None, motion=Path("a"), duration=4.0,
                        split="test", speaker=name, take=f"{take}")  # fmt: skip
            own = gesture(9.0 + s + take, 25.0, seed=10 * s + take)
            for k in (1, 2):
                pair = Pair(f"{name}{take}_s{k}", f"{name}{take}", None, Path("a"),
                            ItemInterval(item))  # fmt: skip
                made = gesture(9.0 + s + take, 25.0, seed=100 + 10 * s + take + 50 * k)
                joints = body_joints(own.skeleton)
                found.setdefault(name, []).append(Clip(pair, made, own, joints, None, ()))
    return found


def sides_of(clips: list[Clip]) -> tuple[list[Motion], list[Motion]]:
    """Return the generated motions, and each recording once."""
    return [c.generated for c in clips], [c.recording for c in clips[::2]]


def test_windows_are_compared_within_speakers(by_speaker):
    every = [*by_speaker["ann"], *by_speaker["ben"]]
    metrics, by_clip, problems = pooled_of(every)
    joints = upper_joints(every[0].recording.skeleton)
    right = drawn = 0.0
    ahead, reach, counts, near, own = [], [], [], [], []
    for clips in by_speaker.values():
        made, recorded = sides_of(clips)
        ours, theirs = (motion_windows(side, joints) for side in (made, recorded))
        back = motion_windows([backwards(m) for m in recorded], joints)
        votes = two_sample_votes(ours, theirs)
        right, drawn = right + votes[0].sum(), drawn + votes[1].sum()
        ahead.append(100 * forward_votes(ours, theirs, back))
        reach.append(100 * within_reach(ours, theirs))
        counts.append(len(theirs))
        near.append(nearest_training(ours, recorded, joints))
        own += [own_windows([recorded[i]], [recorded[1 - i]], joints, 0) for i in range(2)]
    value = {key: found.interval.value for key, found in metrics.items()}
    recording = {key: found.recording for key, found in metrics.items()}
    assert value["one_nn"] == pytest.approx(right / drawn)
    assert value["forward"] == pytest.approx(np.concatenate(ahead).mean())
    assert value["within_reach"] == pytest.approx(np.average(reach, weights=counts))
    assert value["copying"] == pytest.approx(np.median(np.concatenate(near)))
    assert value["copying_low"] == pytest.approx(np.quantile(np.concatenate(near), 0.05))
    for key in ("one_nn", "forward", "within_reach"):
        assert recording[key] == pytest.approx(np.mean([one[key] for one in own])), key
        assert metrics[key].note == "recording: each take against the speaker's others"
        assert metrics[key].interval.n == 8
    # Each take against the speaker's other one: medians and quantiles, averaged.
    quantiles, medians = [], []
    for clips in by_speaker.values():
        _, recorded = sides_of(clips)
        for i in range(2):
            windows = motion_windows(recorded[i], joints)
            distances = nearest_training(windows, [recorded[1 - i]], joints)
            quantiles.append(np.quantile(distances, (0.5, 0.05)))
            medians.append(np.median(distances))
    median, low = np.mean(quantiles, axis=0)
    assert (recording["copying"], recording["copying_low"]) == pytest.approx((median, low))
    ceiling = metrics["copying"].ceiling
    assert (ceiling.value, ceiling.n, ceiling.pieces) == (1.0, 4, False)
    assert ceiling.spread == pytest.approx(np.std(medians, ddof=1) / median)
    # The measures of the first clip are those of its windows.
    first = motion_windows(every[0].generated, joints)
    _, recorded = sides_of(by_speaker["ann"])
    distances = nearest_training(first, recorded, joints)
    assert by_clip[0]["copying"] == pytest.approx(np.median(distances))
    assert by_clip[0]["novelty"] == pytest.approx(np.median(distances) / median)
    assert by_clip[0]["forward"] == pytest.approx(ahead[0][: len(first)].mean())
    assert all(set(one) == {"one_nn", "forward", "copying", "novelty"} for one in by_clip)
    mean = np.mean([one["one_nn"] for one in by_clip])
    assert mean == pytest.approx(right / drawn, abs=0.15)
    pairs = [(c.recording, [c.generated, d.generated]) for c, d in zip(every[::2], every[1::2])]
    calm = calm_and_lively(*map(list, zip(*pairs, strict=True)))
    assert (value["calm_lively_r"], value["calm_lively_slope"]) == pytest.approx(
        (calm.r, calm.slope)
    )
    assert metrics["calm_lively_r"].note == f"{calm.n} windows" and recording["calm_lively_r"] == 1
    assert problems == []


def test_hands_are_pooled_and_compared_with_training(by_speaker, gesture):
    clips = by_speaker["ben"]
    training = TrainingMotion([gesture(8.0, 25.0, seed=5)], ["ben"], note="1 of 2 min of it")
    metrics, _, _ = pooled_of(clips, training)
    made, recorded = sides_of(clips)
    ours, theirs, trained = map(hand_values, (made, recorded, training.motions))
    for key in HAND_KEYS:
        if np.isfinite(ours[key]):
            assert metrics[key].interval.value == pytest.approx(ours[key]), key
            assert metrics[key].recording == pytest.approx(theirs[key]), key
            assert metrics[key].note == f"training recordings: {trained[key]:.2f}"
    note = "recording: against the training split (1 of 2 min of it)"
    assert metrics["copying"].note == metrics["one_nn"].note == note
    joints = upper_joints(clips[0].recording.skeleton)
    distances = nearest_training(motion_windows(made, joints), training.motions, joints)
    assert metrics["copying"].interval.value == pytest.approx(np.median(distances))
    own = own_windows(recorded, training.motions, joints, 0)
    assert metrics["one_nn"].recording == pytest.approx(own["one_nn"])


def test_a_single_take_is_compared_by_halves(by_speaker):
    metrics, _, _ = pooled_of(by_speaker["ben"][2:])
    assert metrics["one_nn"].note == "recording: one half against the other"
    ceiling = metrics["copying"].ceiling
    assert ceiling.pieces and ceiling.n == 2 and ceiling.value == 1.0
    short = [replace(c, generated=c.generated[:30], recording=c.recording[:30])
             for c in by_speaker["ben"][2:]]  # fmt: skip
    metrics, _, problems = pooled_of(short)
    reasons = dict(problems)
    assert "one_nn" in reasons and "copying" in reasons and "reach" in metrics
    assert "speed_range" in reasons and "reach" not in reasons


def test_a_rig_without_hands_has_no_pooled_metrics_of_hands(by_speaker):
    bare = [replace(c, generated=without_joints(replace(c.generated), "Hand"),
                    recording=without_joints(c.recording, "Hand"),
                    joints=tuple(n for n in c.joints if "Hand" not in n))
            for c in by_speaker["ann"]]  # fmt: skip
    metrics, _, problems = pooled_of(bare)
    reasons = dict(problems)
    assert set(HAND_KEYS) <= set(reasons) and "no wrist joints" in reasons["reach"]
    assert "one_nn" in metrics


def test_speakers_of_whom_a_sample_has_no_recording_or_no_clip_are_left_out(
    by_speaker, monkeypatch
):
    """There is room for three takes: the first one of Ben, and one clip of each speaker."""
    every = [*by_speaker["ann"], *by_speaker["ben"]]
    motion = every[0].generated
    room = int(35 * motion.rotations.nbytes / motion.duration)
    monkeypatch.setattr(MotionSample.__init__, "__defaults__", (room,))
    metrics, by_clip, problems = pooled_of(every)
    joints = upper_joints(motion.skeleton)
    made, recorded = by_speaker["ben"][3].generated, by_speaker["ben"][0].recording
    ours, theirs = motion_windows(made, joints), motion_windows(recorded, joints)
    right, drawn = two_sample_votes(ours, theirs)
    assert metrics["one_nn"].interval.value == pytest.approx(right.sum() / drawn.sum())
    distances = nearest_training(ours, [recorded], joints)
    assert metrics["copying"].interval.value == pytest.approx(np.median(distances))
    assert [k for k, values in enumerate(by_clip) if "copying" in values] == [7]
    assert metrics["one_nn"].interval.n == 8 and not problems
    # Hands, of which little is kept, are those of all clips.
    hands = hand_values([clip.generated for clip in every])
    assert metrics["reach"].interval.value == pytest.approx(hands["reach"])


def test_windows_are_drawn_by_the_seed(by_speaker):
    clips = by_speaker["ann"]
    made, recorded = sides_of(clips)
    joints = upper_joints(clips[0].recording.skeleton)
    ours, theirs = (motion_windows(side, joints) for side in (made, recorded))
    found = PooledMetrics(TrainingMotion(), 5)
    for clip in clips:
        found.add(clip)
    metrics = found.pooled()
    usual, drawn = (two_sample_votes(ours, theirs, seed=seed) for seed in (0, 5))
    value = metrics["one_nn"].interval.value
    assert value == pytest.approx(drawn[0].sum() / drawn[1].sum())
    assert value != pytest.approx(usual[0].sum() / usual[1].sum())
    sides = recorded, recorded[::-1]
    own = [own_windows([one], [other], joints, 5)["one_nn"] for one, other in zip(*sides)]
    assert metrics["one_nn"].recording == pytest.approx(np.mean(own))


def test_functions_get_inputs_arguments_and_constants_by_their_names():
    def metric(motion, needed, x=1, resamples=7, other=5):
        return motion, needed, x, resamples, other

    definition = SimpleNamespace(load_function=lambda: metric, arguments={"x": 2})
    first, second = SimpleNamespace(motion="m"), SimpleNamespace(motion="n", needed=3)
    # The first source that has an input gives it; the rest are constants and defaults.
    assert compute(definition, first, second) == ("m", 3, 2, 7, 5)
    assert compute(definition, second, first, resamples=0, unknown=9) == ("n", 3, 2, 0, 5)
    assert compute(definition, second, x=8) == ("n", 3, 2, 7, 5), "the table goes before"
    assert compute(definition, first, SimpleNamespace(needed=None)) is None
    optional = SimpleNamespace(other=None)
    assert compute(definition, second, optional) == ("n", 3, 2, 7, None)
