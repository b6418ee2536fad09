"""The three questions that head a report."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.evaluation import (
    BareItem,
    ClipResult,
    Evaluation,
    Interval,
    Level,
    MetricResult,
    ModelResult,
    Pair,
    SpeedHistogram,
    answers_of,
    headline_lines,
    verdict,
)
from gesturekit.evaluation.results import GroupLikeness
from gesturekit.evaluation.statistics.intervals import groups_of
from gesturekit.evaluation.statistics.likeness import credits, likeness_result, relative, score
from gesturekit.evaluation.statistics.questions import same_verdicts

OWN = {"hand_q50": 0.2, "reach": 0.3, "rest": 20.0, "jerk": 10.0, "foot_skate": 0.02}


def clips(**factors: float) -> list[ClipResult]:
    metrics = {key: value * factors.get(key, 1.0) for key, value in OWN.items()}
    pairs = [Pair(f"r{r}", f"r{r}", None, BareItem(id="a"), BareItem(id="b")) for r in range(3)]
    return [ClipResult(pair, 10.0, metrics, OWN, {}) for pair in pairs]


def result(key: str, value: float, recording: float | None, **more) -> MetricResult:
    return MetricResult(key, Interval(value, None, None, 3, 3, "takes"), recording, **more)


def states(made: list[ClipResult], **metrics: MetricResult) -> dict[str, tuple[str, str]]:
    return {answer.key: (answer.state, answer.sentence) for answer in answers_of(made, metrics)}


def verdict_of(metrics: dict[str, MetricResult]) -> str:
    return verdict(metrics, answers_of(clips(), metrics))


def test_a_ratio_has_full_credit_within_a_quarter_and_none_at_two_and_a_half():
    for factor, credit in ((1.0, 1.0), (1.2, 1.0), (0.85, 1.0), (0.25, 0.0), (3.0, 0.0)):
        assert credits({"reach": 0.3 * factor}, {"reach": 0.3}) == {"reach": pytest.approx(credit)}
    half = credits({"reach": 0.15}, {"reach": 0.3})["reach"]
    assert 0.2 < half < 0.5, "half of the reach is nearer to nothing than to full credit"
    assert credits({}, {}) == {}


def test_one_nn_time_and_side_have_their_own_credit():
    """1-NN: twice the error; side: from 30 % to 50 %."""
    found = credits({"one_nn": 0.8, "forward": 27.0, "sided": 40.0}, {})
    assert found["postures and movements"] == pytest.approx(0.4)
    assert (found["direction of time"], found["left and right"]) == pytest.approx((0.9, 0.5))
    assert score(found) == pytest.approx(np.sqrt(0.9 * 0.4)), "the lower one, with movement"
    assert credits({"one_nn": 0.3}, {})["postures and movements"] == 1.0


def test_no_aspect_makes_up_for_another_by_more_than_the_speakers_own():
    own = {"reach": 0.5, "rests": 0.5, "postures and movements": 0.4, "left and right": 1.0}
    average = {**own, "reach": 1.0, "postures and movements": 0.9}
    assert relative(average, own).value == pytest.approx(1.0)
    # Rests count .05 at least: a tenth of the speaker's own in one of two aspects of movement.
    restless = relative({**average, "rests": 0.0}, own)
    assert restless.value == pytest.approx(0.1**0.25) and restless.aspects["rests"] == 0.1
    mirrored = relative({**average, "left and right": 0.1}, own)
    assert mirrored.value == pytest.approx(np.sqrt(0.1 / 0.4))
    assert relative({}, own).value == pytest.approx(relative(dict.fromkeys(own, 0.0), own).value)
    assert relative(average, {}) is None


def test_a_model_at_chance_is_not_in_time_and_an_uninformative_recording_says_nothing():
    for value, state in ((0.4, "yes"), (0.2, "partly"), (0.05, "no"), (0.9, "partly")):
        found = states(clips(), in_time=result("in_time", value, 0.4))
        assert found["in_time"][0] == state, value
    # Its own chance level: 3 standard errors of sqrt(.4 / 10) of each of three clips, .346 in all.
    for above, state in ((0.4, "yes"), (0.3, "no")):
        metrics = {"sync": 0.1 + above, "sync_chance": 0.1, "sync_z": above / 0.05}
        made = [replace(clip, metrics=metrics) for clip in clips()]
        timed = {"in_time": result("in_time", above, 0.4), "sync": result("sync", 0.5, 0.5)}
        assert states(made, **timed)["in_time"][0] == state
    # Recordings that say nothing: the model is asked alone, by its own interval or deviations.
    unsure = result("in_time", 0.9, 0.4, informative=False)
    state, sentence = states(clips(), in_time=unsure)["in_time"]
    assert state == "cannot be answered" and re.search(r"\b30 s\b.* too few", sentence)
    for more, state in (
        ({}, "cannot be answered"),
        ({"sync_z": result("sync_z", 3.5, 1.0)}, "partly"),
    ):
        assert states(clips(), in_time=unsure, **more)["in_time"][0] == state
    sure = replace(unsure, interval=replace(unsure.interval, low=0.1, high=1.2))
    assert states(clips(), in_time=sure)["in_time"][0] == "partly"
    assert states(clips())["in_time"][0] == "not measured"
    assert "no sound" in states(clips())["in_time"][1]
    assert states(clips())["novelty"][0] == "not measured"


def test_motion_that_follows_the_speech_later_than_the_speaker_is_said_to_be_late():
    for value, lag, state, word in (
        (0.4, 0.25, "partly", "0.3 s later"),
        (0.4, -0.3, "partly", "0.2 s earlier"),
        (0.4, 0.1, "yes", ""),
        (0.2, 0.25, "partly", "loosely"),
    ):
        metrics = of(in_time=(value, 0.4), sync_lag=(lag, -0.07))
        found, sentence = states(clips(), **metrics)["in_time"]
        assert found == state and word in sentence.lower(), lag


def of_group(value: float, name: str = "", takes: int = 1, **aspects: float) -> GroupLikeness:
    return GroupLikeness(name, tuple(f"{name}{i}" for i in range(takes)), value, 0.5, aspects)


def test_the_aspects_that_differ_are_named_where_a_motion_is_not_like_the_speaker():
    for value, state in ((0.9, "yes"), (0.65, "partly"), (0.3, "no")):
        group = of_group(value, reach=0.3, smoothness=0.9)
        like = result("likeness", value, 1.0, groups=(group,))
        found, sentence = states(clips(), likeness=like)["likeness"]
        assert found == state and ("reach" in sentence) == (state != "yes")
        assert "smooth" not in sentence and "not tested against another speaker" in sentence


def test_copies_are_named():
    for value, state, word in ((0.1, "no", "copied"), (0.7, "no", "lively"), (1.0, "yes", "new")):
        copied = result("novelty", value, 1.0)
        found = states(clips(), novelty=copied)["novelty"]
        assert found[0] == state and word in found[1].lower() and "training" in found[1]
    copied = result("novelty", 442.0, 1.0, informative=False)
    assert states(clips(), novelty=copied)["novelty"][0] == "cannot be answered"
    new, low = result("novelty", 1.0, 1.0), result("copying_low", 0.1, 0.3)
    found = states(clips(), novelty=new, copying_low=low)
    assert found["novelty"][0] == "partly" and "occasionally" in found["novelty"][1]
    for degrees, state in ((4.0, "no"), (9.0, "yes")):
        arms = {"copying_left": result("copying_left", degrees, 10.0),
                "copying_right": result("copying_right", 9.0, 10.0)}  # fmt: skip
        found = states(clips(), novelty=new, **arms)["novelty"]
        assert found[0] == state and ("left arm" in found[1]) == (state == "no")
        assert "right arm" not in found[1]
    # Of a mirrored recording: each arm is as near to training motion as the other one was.
    arms = {"copying_left": result("copying_left", 4.0, 10.0),
            "copying_right": result("copying_right", 10.0, 4.0)}  # fmt: skip
    assert states(clips(), novelty=new, **arms)["novelty"][0] == "yes"


def test_whether_motion_is_new_is_not_asked_without_training_motion_each_with_its_reason():
    windows, new = result("one_nn", 0.7, 0.7), result("novelty", 1.0, 1.0)
    trained = [replace(c, pair=replace(c.pair, reference=BareItem(id="b", split="train")))
               for c in clips()]  # fmt: skip
    for made, metrics, reason in (
        (clips(), {"one_nn": windows}, "training split"),
        (clips(), {}, "too short"),
        (trained, {"one_nn": windows}, "trained on"),
        (clips(), {"novelty": new, "near_still": result("near_still", 97.0, 10.0)}, "hardly move"),
    ):
        state, sentence = states(made, **metrics)["novelty"]
        assert state in ("not measured", "cannot be answered") and reason in sentence


def spoken_by(speaker: str, stem: str, style: str | None = None) -> Pair:
    recording = BareItem(id="b", speaker=speaker, style=style, split="train")
    return Pair(stem, stem, None, BareItem(id="a"), recording)


def test_speakers_are_averaged_by_takes_and_named_where_they_differ():
    groups = [of_group(0.2, "a", 3, reach=0.3), of_group(1.0, "b", 1, reach=1.0)]
    like = likeness_result(groups, {}, 8)
    assert like.interval.value == pytest.approx(0.4) and like.interval.low is None
    state, sentence = states(clips(), likeness=like)["likeness"]
    assert state == "no" and re.search(r"\breach.*\ba 0.20.*\bb 1.00", sentence)
    assert likeness_result([], {}, 8) is None


def test_the_interval_of_likeness_is_the_jackknife_over_both_sets_of_takes():
    """Variances 4/5 of the sums of squares .002 and .0002; t(4) = 2.776 on the logit scale."""
    own = {f"t{i}": 0.7 + 0.01 * i for i in (-1, -3, 0, 1, 3)}
    group = GroupLikeness("", tuple(own), 0.7, 0.5, {}, own, (0.69, 0.7, 0.7, 0.7, 0.71))
    found = likeness_result([group], {}, 5).interval
    half = 2.776 * np.sqrt(0.8 * (0.002 + 0.0002)) / (0.7 * 0.3)
    ends = [1 / (1 + np.exp(-(np.log(0.7 / 0.3) + sign * half))) for sign in (-1, 1)]
    assert (found.low, found.high) == pytest.approx(tuple(ends), abs=1e-3)
    assert likeness_result([replace(group, value=1.0)], {}, 5).interval.low is None
    assert likeness_result([replace(group, pieces=True)], {}, 5).interval.low is None
    # A single take to compare with adds nothing.
    single = likeness_result([replace(group, without_reference=(0.5,))], {}, 5).interval
    half *= np.sqrt(0.002 / 0.0022)
    assert single.low == pytest.approx(1 / (1 + np.exp(half - np.log(0.7 / 0.3))), abs=1e-3)


def test_a_few_seconds_are_too_few_to_say_whether_a_motion_is_like_the_speaker():
    like = likeness_result([of_group(0.9)], {}, 3)
    for seconds, state in ((4.9, "cannot be answered"), (5.1, "yes")):
        short = [replace(clip, seconds=seconds) for clip in clips()]
        assert states(short, likeness=like)["likeness"][0] == state


def test_a_speaker_whose_takes_have_nothing_in_common_is_not_asked_about():
    like = likeness_result([replace(of_group(0.9), own=0.1)], {}, 3)
    assert states(clips(), likeness=like)["likeness"][0] == "cannot be answered"


def test_styles_are_groups_where_each_has_three_recordings():
    angry = [spoken_by("a", f"angry{i}", "angry") for i in range(3)]
    calm = [spoken_by("a", f"calm{i}", "calm") for i in range(3)]
    other = [spoken_by("b", "sad", "sad")]
    assert groups_of([*angry, *calm, *other]) == ["a, angry"] * 3 + ["a, calm"] * 3 + ["b"]
    assert groups_of([*angry, *calm[:2]]) == ["a"] * 5
    assert groups_of([Pair("x", "x", None, BareItem(id="a"), BareItem(id="b"))]) == [""]


def test_a_score_is_placed_between_its_floor_and_its_ceiling():
    """The floor of .2 ± .2 over four takes is reached up to .3; yes from .9 - 1.64 · .05 = .818."""
    floors = (Level("mean pose", 0.0, None, 0), Level("another speaker", 0.2, 0.2, 4))
    ceiling = Level("the speaker's other takes", 0.9, 0.05, 6)
    for value, state, facts in (
        (0.25, "no", ["floor", "another speaker"]),
        (0.5, "no", []),
        (0.75, "partly", []),
        (0.83, "yes", []),
        (1.0, "yes", []),
    ):
        like = result("likeness", value, 1.0, floors=floors, ceiling=ceiling)
        found, sentence = states(clips(), likeness=like)["likeness"]
        assert found == state and all(fact in sentence for fact in facts), value
        assert [w for w in ("floor", "ceiling") if w in sentence] == facts[:1], value
        assert "not tested" not in sentence
    single = result("likeness", 0.85, 1.0, ceiling=replace(ceiling, spread=None, n=1))
    assert states(clips(), likeness=single)["likeness"][0] == "partly", "no spread is known"
    # However much the speaker's takes differ, .7 is needed for yes and .6 for partly.
    own = Level("the speaker's other takes", 0.8, 0.2, 6)
    for value, state in ((0.71, "yes"), (0.69, "partly"), (0.59, "no")):
        like = result("likeness", value, 1.0, ceiling=own)
        assert states(clips(), likeness=like)["likeness"][0] == state
    other = (Level("another speaker", 0.95, None, 1),)
    high = result("likeness", 0.3, 1.0, informative=False, floors=other, ceiling=ceiling)
    state, sentence = states(clips(), likeness=high)["likeness"]
    assert state == "cannot be answered" and "floor" in sentence and "ceiling" in sentence


def of(**values: float | tuple[float, float]) -> dict[str, MetricResult]:
    """Results by key: the value, or value and recording's own."""
    pairs = {k: v if isinstance(v, tuple) else (v, None) for k, v in values.items()}
    return {key: result(key, *pair) for key, pair in pairs.items()}


@pytest.mark.parametrize(
    ("metrics", "fact"),
    [
        ({"joint_limits": (71.0, 2.0)}, "71 %"),
        ({"joint_limits": (30.0, 2.0), "one_nn": (1.0, 0.7), "within_reach": (0.0, 20.0)}, "30 %"),
        ({"jerk_genea": (200.0, 20.0)}, "10 times"),
        ({"feet_above_floor": (173.0, 11.0)}, "173 mm"),
        ({"floor_penetration": (147.0, 1.0)}, "147 mm"),
        ({"foot_skate": (0.5, 0.02)}, "0.50 m/s"),
        ({"worst_joint": (95.0, 0.0)}, "95 %"),
        ({"bone_length_change": (12.0, 3.0)}, "12 %"),
    ],
)
def test_a_broken_body_is_named_first_and_not_praised(metrics, fact):
    praised = {
        "sync": (1.0, 1.0),
        "reach": (1.0, 1.0),
        "in_time": (0.5, 0.5),
        "novelty": (1.0, 1.0),
    }
    found = of(**praised, **metrics)
    words = verdict_of(found)
    assert fact in words and "broken" in words and not re.search("in time|reach", words)
    answered = {answer.key: answer for answer in answers_of(clips(), found)}
    assert {answer.state for answer in answered.values()} == {"not asked"}
    assert all(fact in answer.sentence for answer in answered.values())
    assert ("another speaker" in words) == ("30 %" in words), "it may be that, and says so"
    # Another speaker on this rig, and one who does other things within the same range.
    for beyond, reached in ((30.0, 9.0), (12.0, 0.0)):
        sound = {"joint_limits": (beyond, 2.0), "one_nn": (1.0, 0.7), "jerk_genea": (60.0, 20.0)}
        sound |= {"feet_above_floor": (171.0, 11.0), "bone_length_change": (12.0, 4.0)}
        sound |= {"floor_penetration": (101.0, 1.0), "foot_skate": (0.5, 0.11)}
        sound |= {"worst_joint": (74.0, 0.0)}
        assert "broken" not in verdict_of(of(**praised, **sound, within_reach=(reached, 20.0)))


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        (of(near_still=95.0), "hardly move"),
        (of(near_still=(20.0, 10.0), rest=(32.0, 32.0)), "frozen 20"),
        (of(near_still=(12.0, 10.0), rest=(32.0, 32.0)), "rest"),
        (of(rest=(1.0, 1.0)), ""),
        (of(rest=(2.0, 2.0)), "rest"),
        (of(rest=(2.0, 10.0)), "hardly rest"),
        (of(rest=(5.0, 10.0)), "seldom rest"),
        (of(rest=(20.0, 10.0)), "more rest"),
        (of(reach=(0.9, 1.0)), "reach"),
        (of(reach=(0.7, 1.0)), "thirds reach"),
        (of(reach=(1.4, 1.0)), "half times reach"),
        (of(reach=(1.0, 0.0)), ""),
        (of(hand_q90=(2.0, 1.0)), "twice speed"),
        (of(calm_lively_r=0.2), "lively"),
        (of(calm_lively_r=0.6), ""),
        (of(in_time=(0.2, 0.2)), "in time"),
        (of(in_time=(0.2, 0.1)), "in time more"),
        (of(in_time=(0.5, 1.0)), "loosely in time"),
        (of(in_time=(0.2, 1.0)), "not in time"),
        (of(novelty=(0.3, 1.0)), "mostly copied"),
        (of(novelty=(0.7, 1.0)), "partly copied lively"),
        (of(novelty=(0.9, 1.0)), ""),
        (of(copying_low=(0.4, 1.0), novelty=(0.9, 1.0)), "occasionally copied"),
        (of(copying_left=(0.4, 1.0), novelty=(0.9, 1.0)), "mostly copied left arm"),
    ],
)  # fmt: skip
def test_the_verdict_names_what_differs_from_the_recordings(metrics, said):
    telling = "frozen hardly seldom more thirds half twice lively loosely not mostly partly copied"
    words = set(re.findall(r"\w+", verdict_of(metrics).lower()))
    assert set(said.split()) <= words and words & set(telling.split()) <= set(said.split())
    assert said or not words


def test_the_verdict_says_whether_the_motion_is_like_the_speakers():
    for value, said in (
        (0.9, "speed, moves like this speaker."),
        (0.65, "speed, moves somewhat like this speaker."),
        (0.3, "speed, does not move like this speaker."),
    ):
        like = likeness_result([of_group(value)], {}, 3)
        metrics = {**of(hand_q90=(1.0, 1.0)), "likeness": like}
        assert verdict_of(metrics).endswith(said)
    unknown = likeness_result([replace(of_group(0.9), own=0.1)], {}, 3)
    assert "like" not in verdict_of({**metrics, "likeness": unknown})


def test_models_with_one_verdict_are_told_apart_where_intervals_do_not_overlap():
    def model(label: str, verdict: str, **speeds: tuple[float, float]) -> ModelResult:
        metrics = {
            key: MetricResult(key, Interval(sum(ends) / 2, *ends, 3, 3, "takes"))
            for key, ends in speeds.items()
        }
        return ModelResult(label, Path(label), verdict, metrics=metrics)

    a = model("a", "Same.", wrist_speed=(0.1, 0.2), jerk=(1.0, 3.0))
    b = model("b", "Same.", wrist_speed=(0.3, 0.4), jerk=(2.0, 4.0))
    other = model("c", "Other.", wrist_speed=(0.8, 0.9))
    (sentence,) = same_verdicts([a, b, other])
    assert re.search(r"\ba, b\b.*Wrist speed.*0\.15 to 0\.35", sentence)
    assert "Jerk" not in sentence
    (sentence,) = same_verdicts([a, replace(b, metrics=a.metrics)])
    assert "no metric" in sentence


def test_floors_stand_at_the_question_and_again_only_where_a_model_has_others(page_of):
    floor, other = Level("mean pose", 0.111, None, 0), Level("another speaker", 0.222, 0.3, 0)

    def model(label: str, *floors: Level, low: float | None = None) -> ModelResult:
        interval = Interval(0.5, low, None if low is None else 0.6, 3, 3, "takes")
        timed = MetricResult("in_time", interval, 0.9, floors=floors)
        made = clips()
        return ModelResult(
            label, Path(label), answers=answers_of(made, {"in_time": timed}),
            metrics={"in_time": timed}, clips=made,
        )  # fmt: skip

    def rows(*models: ModelResult) -> list[str]:
        settings = {"variants": {}, "seed": 0}
        made = Evaluation(
            list(models), Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0)
        )
        shown = re.sub("<title>.*?</title>|<p>.*?</p>", "", page_of(made))
        shown = shown[shown.index("Three questions") : shown.index("Figures")]
        return re.findall(r"<tr>.*?</tr>", shown, re.DOTALL)

    head, *alike = rows(model("a", floor), model("b", floor))
    assert "0.11" in head and not any("0.11" in row or "no interval" in row for row in alike)
    head, first, second = rows(model("a", floor), model("b", other, low=0.4))
    assert "0.11" in head and "0.11" not in first and "0.22" in second
    assert "no interval" in first and "0.40 to 0.60" in second
    # From .222 - .3 at 6 to .222 + .3 at 254.
    assert all(f'"{x}"' in second for x in (244.9, 6.0, 248.0, 130.0)) and '"84.1"' in first


def test_a_broken_body_has_no_score_on_the_page_and_does_not_stretch_the_lines(page_of):
    def model(label: str, novelty: float, limits: float) -> ModelResult:
        metrics = of(novelty=(novelty, 1.0), joint_limits=(limits, 2.0))
        made = clips()
        return ModelResult(
            label, Path(label), answers=answers_of(made, metrics), metrics=metrics, clips=made
        )

    settings = {"variants": {}, "seed": 0}
    models = [model("sound", 0.901, 2.0), model("broken", 77.3, 71.0)]
    made = Evaluation(models, Path("r"), 25.0, "", settings, SpeedHistogram(), np.zeros(0))
    page = page_of(made)
    shown = page[page.index("Three questions") : page.index("Figures")]
    assert "0.90" in shown and "71 %" in shown and "77.3" not in shown
    lines = headline_lines(made)
    assert any("0.90" in line for line in lines) and not any("77.3" in line for line in lines)
