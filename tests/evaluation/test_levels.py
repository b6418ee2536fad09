"""Floors and ceilings of the three questions: who scores like whom."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest

from gesturekit.corpus import Item, Manifest
from gesturekit.evaluation import (
    BareItem,
    ClipResult,
    Evaluation,
    Interval,
    Level,
    MetricResult,
    ModelResult,
    Pair,
    answer_questions,
    evaluate,
    metric_results,
)
from gesturekit.evaluation.results import OTHER_SPEAKER
from gesturekit.evaluation.statistics.model_metrics import (
    CEILING,
    MEAN_POSE,
    level_of,
    reached_floor,
)


def show(shared_data: Path, speaker: str) -> list[Item]:
    """Clips of SHOW of 10 s, each a take of its own."""
    files = sorted((shared_data / "takes" / "show").glob(f"{speaker}_*.npz"))
    return [
        Item(id=p.stem, audio=p.with_suffix(".wav"), motion=p, duration=10.0, speaker=speaker,
             split="test")
        for p in files
    ]  # fmt: skip


def zeroeggs(shared_data: Path, pieces: Sequence[tuple[float, float]]) -> list[Item]:
    """Pieces (start, duration) of each of the three takes of one speaker of ZeroEGGS."""
    files = sorted((shared_data / "takes" / "zeggs_neutral" / "one_rig").glob("*.bvh"))
    return [
        Item(id=f"{p.stem}_{n}", take=p.stem, audio=p.with_suffix(".wav"), motion=p,
             audio_start=start, motion_start=start, duration=seconds, speaker="zeggs",
             split="test")
        for p in files
        for n, (start, seconds) in enumerate(pieces)
    ]  # fmt: skip


def judged(
    items: Sequence[Item], others: Callable[[Item], Item], folder: Path, **options
) -> Evaluation:
    """Evaluate recordings in the place of generated clips: of each item that of another one."""
    Manifest(items).save(folder / "corpus.jsonl")
    for item in items:
        motion = others(item).load_motion()
        frames = min(motion.n_frames, round(item.duration * motion.fps))
        motion[:frames].save(folder / "made" / f"{item.id}.npz")
    return evaluate(folder / "made", folder / "corpus.jsonl", **options)


@pytest.fixture(scope="module")
def two_speakers(shared_data, tmp_path_factory) -> dict[str, Evaluation]:
    """ZeroEGGS and SHOW in one corpus: each speaker moves like the other, or as in another take."""
    oliver, zeggs = show(shared_data, "oliver"), zeroeggs(shared_data, [(10.0, 20.0)])
    own = {"oliver": oliver, "zeggs": zeggs}

    def following(item: Item, speaker: str) -> Item:
        return own[speaker][(own[item.speaker].index(item) + 1) % len(own[speaker])]

    other = {"oliver": "zeggs", "zeggs": "oliver"}
    like = {"another": other.get, "same": str}
    return {
        name: judged(
            [*oliver, *zeggs],
            lambda item, of=of: following(item, of(item.speaker)),
            tmp_path_factory.mktemp(name),
        )
        for name, of in like.items()
    }


@pytest.mark.stress
def test_another_speaker_stands_at_the_floor_and_other_takes_at_the_ceiling(two_speakers):
    another, same = (two_speakers[name].models[0].metrics["likeness"] for name in two_speakers)
    floors = {level.name: level for level in another.floors}
    floor, ceiling = floors[OTHER_SPEAKER], another.ceiling
    assert (floor.n, ceiling.n, ceiling.pieces) == (2, 7, False)
    assert ceiling.value - ceiling.spread > floor.value + floor.spread
    assert floors[MEAN_POSE].value < floor.value
    assert another.interval.value == pytest.approx(floor.value, abs=0.15)
    assert same.interval.value >= ceiling.value - ceiling.spread
    assert same.informative and another.informative
    asked = {a.key: a.sentence for a in two_speakers["same"].models[0].answers}
    assert "training split" in asked["novelty"], "all recordings are of the test split"


def result(value: float, ceiling: Level | None, *floors: Level) -> MetricResult:
    interval = Interval(value, None, None, 3, 3, "takes")
    return MetricResult("in_time", interval, ceiling=ceiling, floors=floors)


def test_a_floor_differs_from_the_ceiling_by_a_t_test_over_takes():
    """Both with sd .1 of 4 takes: t(6) = 1.943, times .1 sqrt(1/4 + 1/4), is .137."""
    ceiling = Level(CEILING, 0.8, 0.1, 4)
    for value, differs in ((0.6, True), (0.7, False)):
        found = result(0.7, ceiling, Level(OTHER_SPEAKER, value, 0.1, 4))
        assert (reached_floor(found) is None) == differs, value
    # A floor by definition has no error: t(3) = 2.353 times .1 / 2 is .118.
    assert reached_floor(result(0.7, ceiling, Level("zero", 0.65, None, 0))) is None
    assert reached_floor(result(0.7, ceiling, Level("zero", 0.72, None, 0))) is not None
    assert reached_floor(result(0.7, Level(CEILING, 0.5), Level("one", 0.4))) is None
    assert reached_floor(result(0.7, Level(CEILING, 0.5), Level("one", 0.5))) is not None
    assert reached_floor(result(0.7, None, Level("one", 0.4))) is None
    # The least likeness of a motion like the speaker is .8 - 1.64 · .05 = .718.
    for floor, below in ((0.71, True), (0.72, False)):
        like = replace(
            result(0.7, Level(CEILING, 0.8, 0.05, 3), Level("one", floor)), key="likeness"
        )
        assert (reached_floor(like) is None) == below


def test_models_that_ignore_the_speech_are_floors_of_the_others():
    def model(label: str, timing: float, own: float) -> ModelResult:
        pairs = [Pair(f"r{r}", f"r{r}", None, BareItem(id="a"), BareItem(id="b")) for r in range(3)]
        metrics, recorded = {"in_time": timing, "reach": 0.2}, {"in_time": own, "reach": 0.3}
        clips = [ClipResult(pair, 9.0, dict(metrics), recorded, {}) for pair in pairs]
        return ModelResult(label, Path(label), clips=clips, metrics=metric_results(clips, {}, {}))

    models = [model("ours", 0.28, 0.4), model("speech_blind", 0.3, 0.4)]
    answer_questions(models)
    timing = models[0].metrics["in_time"]
    assert {level.name: level.value for level in timing.floors} == pytest.approx(
        {MEAN_POSE: 0.0, "speech_blind": 0.3}
    )
    assert "speech_blind" in models[0].answers[0].sentence
    assert models[0].answers[0].state == "no"
    assert [level.name for level in models[1].metrics["in_time"].floors] == [MEAN_POSE]
    models = [model("ours", 0.28, 0.25), model("speech_blind", 0.3, 0.25)]
    answer_questions(models)
    assert models[0].answers[0].state == "cannot be answered"


def test_the_recordings_own_value_is_that_of_the_next_recording_of_another_take(gesture, tmp_path):
    """The next one of another take is c for a and b, which are one take, and a for c."""
    motions = {name: gesture(4.0, 10.0, seed=k) for k, name in enumerate("abc")}
    items = []
    for name, motion in motions.items():
        motion.save(tmp_path / f"{name}.npz")
        items.append(Item(id=name, audio=None, motion=tmp_path / f"{name}.npz", duration=4.0,
                          split="test", take="c" if name == "c" else "ab"))  # fmt: skip
    Manifest(items).save(tmp_path / "corpus.jsonl")
    for name, other in zip("abc", "cca", strict=True):
        motions[other].save(tmp_path / "made" / f"{name}.npz")
    (model,) = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl").models
    for key in ("rmse", "cca", "coverage", "local_diversity"):
        found = model.metrics[key]
        assert found.recording == pytest.approx(found.interval.value), key


def test_novelty_has_the_takes_of_the_recordings_as_its_ceiling(gesture, tmp_path):
    items = []
    for k, (name, split) in enumerate((("a", "test"), ("b", "test"), ("c", "train"))):
        gesture(6.0, 25.0, seed=k).save(tmp_path / f"{name}.npz")
        items.append(Item(id=name, audio=None, motion=tmp_path / f"{name}.npz", duration=6.0,
                          split=split))  # fmt: skip
        if split == "test":
            gesture(6.0, 25.0, seed=9 + k).save(tmp_path / "made" / f"{name}.npz")
    Manifest(items).save(tmp_path / "corpus.jsonl")
    (model,) = evaluate(tmp_path / "made", tmp_path / "corpus.jsonl", cheap=True).models
    ceiling = model.metrics["novelty"].ceiling
    assert (ceiling.name, ceiling.value, ceiling.n) == (CEILING, 1.0, 2) and ceiling.spread > 0.0


def test_a_level_is_mean_and_standard_deviation_of_takes():
    assert level_of("x", [1.0, 2.0, 3.0, 6.0]) == Level("x", 3.0, pytest.approx(2.160247), 4)
    assert level_of("x", [2.0]) == Level("x", 2.0, None, 1)
