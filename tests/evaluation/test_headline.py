"""The three questions that head a report."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gesturekit.evaluation.metrics.distributions import SpeedHistogram
from gesturekit.evaluation.pairs import ItemInterval, Pair
from gesturekit.evaluation.report.headline import headline, headline_lines, interval_warnings
from gesturekit.evaluation.report.plots import colour
from gesturekit.evaluation.results import (
    ClipResult,
    Evaluation,
    Finding,
    Interval,
    Level,
    MetricResult,
    ModelResult,
)
from gesturekit.evaluation.statistics.groups import groups_of
from gesturekit.evaluation.statistics.levels import CEILING
from gesturekit.evaluation.statistics.likeness import credits, likeness
from gesturekit.evaluation.statistics.paired import Contest
from gesturekit.evaluation.statistics.questions import (
    answers,
    in_words,
    likeness_by_group,
    likeness_of,
    likeness_result,
    verdict,
)

OWN = {"hand_q50": 0.2, "reach": 0.3, "rest": 20.0, "jerk": 10.0, "foot_skate": 0.02}


def clips(**factors: float) -> list[ClipResult]:
    metrics = {key: value * factors.get(key, 1.0) for key, value in OWN.items()}
    pairs = [Pair(f"r{r}", f"r{r}", None, Path("a"), Path("b")) for r in range(3)]
    return [ClipResult(pair, 10.0, metrics, OWN, {}) for pair in pairs]


def result(key: str, value: float, recording: float | None, **more) -> MetricResult:
    return MetricResult(key, Interval(value, None, None, 3, 3, "takes"), recording, **more)


def states(made: list[ClipResult], **metrics: MetricResult) -> dict[str, tuple[str, str]]:
    return {answer.key: (answer.state, answer.sentence) for answer in answers(made, metrics)}


def test_likeness_is_one_within_a_quarter_and_falls_to_nothing_at_two_and_a_half():
    for factor, credit in ((1.0, 1.0), (1.2, 1.0), (0.85, 1.0), (0.25, 0.0), (3.0, 0.0)):
        ours = {"reach": np.array(0.3 * factor)}
        assert likeness(ours, {"reach": np.array(0.3)}) == pytest.approx(credit)
    half = likeness({"reach": np.array(0.15)}, {"reach": np.array(0.3)})
    # ln 2.5 - ln(0.305 / 0.155) over ln 2: 5 mm are added to both sides
    assert half == pytest.approx(
        (np.log(2.5) - np.log(0.305 / 0.155)) / (np.log(2.5) - np.log(1.25))
    )
    assert likeness({}, {}) is None


def test_one_nn_and_direction_of_time_have_their_own_credit():
    found = credits({"one_nn": np.array(0.8), "forward": np.array(0.0)}, {}, own_one_nn=0.6)
    assert found["postures and movements"] == pytest.approx(0.5)
    assert found["direction of time"] == 0.0
    assert credits({"one_nn": np.array(0.3)}, {})["postures and movements"] == 1.0


def test_a_model_at_chance_is_not_in_time_and_an_uninformative_recording_says_nothing():
    for value, state in ((0.4, "yes"), (0.2, "partly"), (0.05, "no"), (0.9, "partly")):
        found = states(clips(), in_time=result("in_time", value, 0.4))
        assert found["in_time"][0] == state, value
    found = states(clips(), in_time=result("in_time", 0.9, 0.4, informative=False))
    assert found["in_time"][0] == "cannot be answered"
    assert "Cannot be answered on this corpus" in found["in_time"][1]
    assert states(clips())["in_time"][0] == "not measured"
    state, words = states(clips())["novelty"]
    assert state == "not measured" and "too short, or the rig's arms and legs" in words


def test_the_aspects_that_differ_are_named():
    like = result("likeness", 0.95, 0.9)
    assert states(clips(), likeness=like)["likeness"] == ("yes", "Moves like this speaker.")
    state, sentence = states(clips(reach=0.3), likeness=like)["likeness"]
    assert (state, sentence) == ("partly", "Moves mostly like this speaker; what differs: reach.")
    assert states(clips(jerk=9.0), likeness=result("likeness", 0.3, 0.9))["likeness"][0] == "no"


def test_copies_are_named():
    for value, state, words in (
        (0.1, "no", "Mostly copied"),
        (0.7, "no", "less lively"),
        (1.0, "yes", "New: as far"),
    ):
        copied = result("novelty", value, 1.0, note="recording: against the training split")
        found = states(clips(), novelty=copied)["novelty"]
        assert found[0] == state and words in found[1] and "training motion" in found[1]
    low = result("copying_low", 0.1, 0.3)
    copied = result("novelty", 442.0, 1.0, informative=False)
    state, words = states(clips(), novelty=copied)["novelty"]
    assert state == "cannot be answered" and "the same as the recordings" in words
    found = states(clips(), novelty=result("novelty", 1.0, 1.0), copying_low=low)
    assert found["novelty"][0] == "partly" and "occasionally" in found["novelty"][1]


class Said:
    """An item that names a speaker and a style."""

    def __init__(self, speaker: str, style: str | None = None) -> None:
        self.speaker, self.style, self.take = speaker, style, ""


def spoken_by(speaker: str, stem: str, style: str | None = None) -> Pair:
    return Pair(stem, stem, None, Path("a"), ItemInterval(Said(speaker, style)))


def test_each_speaker_is_compared_with_own_recordings_and_speakers_are_averaged_by_takes():
    """Reach .1 and .4 m with that of the other speaker: pooled .25 and .25, the credit 1."""
    reach = {"a": 0.1, "b": 0.4}
    made = [
        ClipResult(spoken_by(who, stem), 9.0, {"reach": ours}, {"reach": reach[who]}, {})
        for who, stem, ours in (("a", "1", 0.4), ("a", "2", 0.4), ("b", "3", 0.4), ("b", "4", 0.4))
    ]
    measure = likeness_of(made, 0.6)
    assert likeness_by_group(made, 0.6) == {"a": 0.0, "b": 1.0}
    assert measure(np.full((1, 4), 0.25)) == pytest.approx(0.5)
    # Three quarters of the weight on the takes of b; none on those of a.
    assert measure(np.array([[0.25, 0.0, 0.5, 0.25], [0.0, 0.0, 0.5, 0.5]])) == pytest.approx(
        [0.75, 1.0]
    )
    like = result("likeness", 0.5, 0.9)
    state, sentence = states(made, likeness=like)["likeness"]
    assert state == "no" and "it differs between speakers: a 0.00, b 1.00" in sentence


def test_styles_are_groups_where_each_has_three_recordings():
    angry = [spoken_by("a", f"angry{i}", "angry") for i in range(3)]
    calm = [spoken_by("a", f"calm{i}", "calm") for i in range(3)]
    other = [spoken_by("b", "sad", "sad")]
    assert groups_of([*angry, *calm, *other]) == ["a, angry"] * 3 + ["a, calm"] * 3 + ["b"]
    assert groups_of([*angry, *calm[:2]]) == ["a"] * 5
    assert groups_of([Pair("x", "x", None, Path("a"), Path("b"))]) == [""]


@pytest.mark.parametrize(
    ("value", "low", "state", "words"),
    [
        (0.6, None, "no", "Not in time"),
        (0.6, 0.1, "no", "Not in time"),
        (1.4, -0.1, "no", "Not in time"),  # of 3: not surely above chance
        (2.1, 0.0, "yes", "As much in time"),
        (0.9, None, "partly", "Loosely"),
        (2.1, None, "yes", "As much in time"),
        (3.9, None, "yes", "As much in time"),
        (3.91, None, "partly", "more strictly"),
    ],
)
def test_thresholds_of_timing_belong_to_the_better_answer(value, low, state, words):
    interval = Interval(value, low, None, 3, 3, "takes")
    found = states(clips(), in_time=MetricResult("in_time", interval, 3.0))["in_time"]
    assert found[0] == state and words in found[1]


def test_a_score_is_placed_between_its_floor_and_its_ceiling():
    """The floor of .2 ± .2 over four takes is reached up to .3."""
    floors = (Level("mean pose", 0.0, None, 0), Level("another speaker", 0.2, 0.2, 4))
    ceiling = Level("the speaker's other takes", 0.9, 0.05, 6)
    for value, expected in (
        (0.3, "Does not move like this speaker; no higher than its floor, another speaker "
              "(0.20 ± 0.20)."),
        (0.301, "Does not move like this speaker."),
        (0.54, "Moves somewhat like this speaker."),  # .6 of .9
        (0.539, "Does not move like this speaker."),
        (0.85, "Moves like this speaker."),
        (0.849, "Moves somewhat like this speaker."),
        (0.95, "Moves like this speaker."),
        (0.951, "Moves like this speaker; above its ceiling, the speaker's other takes "
                "(0.90 ± 0.05)."),
    ):  # fmt: skip
        like = result("likeness", value, 0.9, floors=floors, ceiling=ceiling)
        assert states(clips(), likeness=like)["likeness"][1] == expected, value
    # A speaker whose takes differ is reached at their likeness, not at 0.85.
    for value, state in ((0.5, "yes"), (0.49, "partly"), (0.3, "partly"), (0.29, "no")):
        assert states(clips(), likeness=result("likeness", value, 0.5))["likeness"][0] == state
    high = result("likeness", 0.3, 0.9, informative=False, floors=floors, ceiling=floors[1])
    state, sentence = states(clips(), likeness=high)["likeness"]
    assert state == "cannot be answered"
    assert "the floor, another speaker (0.20 ± 0.20), is not surely below the ceiling" in sentence


@pytest.mark.parametrize(
    ("value", "low", "sentence"),
    [
        (0.49, None, "Mostly copied from the recordings."),
        (0.5, None, "Nearer to the recordings than other recordings are: partly copied, or less "
                    "lively."),
        (0.79, None, "Nearer to the recordings than other recordings are: partly copied, or less "
                     "lively."),
        (0.8, None, "New: as far from the recordings as other recordings."),
        (0.8, 0.18, "New: as far from the recordings as other recordings."),
        (0.8, 0.179, "New, but occasionally copied from the recordings."),
        (1.1, None, "New: as far from the recordings as other recordings."),
        (1.11, None, "New: farther from the recordings than other recordings, as odd motion is "
                     "too."),
    ],
)  # fmt: skip
def test_thresholds_of_novelty(value, low, sentence):
    ceiling = Level("the speaker's other takes", 1.0, 0.1, 6)
    metrics = {"novelty": result("novelty", value, 1.0, ceiling=ceiling)}
    if low is not None:
        metrics["copying_low"] = result("copying_low", low, 0.3)
    assert states(clips(), **metrics)["novelty"][1] == sentence
    seeds = result("inter_diversity", 1.5, 2.0)
    expected = (
        sentence[:-1] + "; two samples of one speech differ 75 % as much as two recordings do."
    )
    assert states(clips(), **metrics, inter_diversity=seeds)["novelty"][1] == expected
    still = result("inter_diversity", 1.5, 0.0)
    assert states(clips(), **metrics, inter_diversity=still)["novelty"][1] == sentence


def test_aspects_of_groups_are_averaged_by_their_takes():
    """Reach is right for a's three takes and nothing for b's one: the credit is .75, enough."""
    for wrong, named in ((1, False), (2, True)):
        made = [
            ClipResult(
                spoken_by("ab"[k >= 4 - wrong], f"{k}"), 9.0,
                {"reach": 9.0 if k >= 4 - wrong else 0.3}, {"reach": 0.3}, {},
            )
            for k in range(4)
        ]  # fmt: skip
        sentence = states(made, likeness=result("likeness", 0.7, 0.9))["likeness"][1]
        assert ("what differs: reach" in sentence) == named
    # A clip that lacks a measure takes it from its own group alone.
    made[-1].metrics.clear()
    assert likeness_by_group(made, 0.6) == {"a": 1.0}


@pytest.mark.parametrize(
    ("ratio", "words"),
    [
        (0.069, "next to nothing of"), (0.07, "a tenth of"), (0.2, "a quarter of"),
        (0.3, "a third of"), (0.4, "a third of"), (0.45, "half of"), (0.6, "two thirds of"),
        (0.7, "two thirds of"), (0.72, "three quarters of"), (1.4, "one and a half times"),
        (1.7, "one and a half times"), (1.8, "twice"), (2.4, "twice"), (2.5, "three times"),
        (3.5, "four times"), (5.0, "four times"), (5.01, "many times"),
    ],
)  # fmt: skip
def test_ratios_have_the_nearest_words(ratio, words):
    assert in_words(ratio) == words


def of(**values: float | tuple[float, float]) -> dict[str, MetricResult]:
    """Results by key: the value, or value and recording's own."""
    pairs = {k: v if isinstance(v, tuple) else (v, None) for k, v in values.items()}
    return {key: result(key, *pair) for key, pair in pairs.items()}


@pytest.mark.parametrize(
    ("metrics", "said"),
    [
        (of(near_still=90.0), "The hands hardly move."),
        (of(near_still=89.9), "Hands frozen in 90 % of the time."),
        (of(near_still=(15.0, 10.0), rest=(32.0, 32.0)), "At rest as often as the speaker."),
        (of(near_still=(15.1, 10.0), rest=(32.0, 32.0)), "Hands frozen in 15 % of the time."),
        (of(rest=(2.0, 2.0)), "At rest as often as the speaker."),
        (of(rest=(2.0, 1.9)), ""),
        (of(rest=(3.4, 10.0)), "Hardly ever at rest."),
        (of(rest=(3.5, 10.0)), "Seldom at rest."),
        (of(rest=(6.9, 10.0)), "Seldom at rest."),
        (of(rest=(7.0, 10.0)), "At rest as often as the speaker."),
        (of(rest=(14.0, 10.0)), "At rest as often as the speaker."),
        (of(rest=(14.1, 10.0)), "At rest more often than the speaker."),
        (of(reach=(0.8, 1.0)), "The speaker's reach."),
        (of(reach=(1.25, 1.0)), "The speaker's reach."),
        (of(reach=(0.79, 1.0)), "Three quarters of the speaker's reach."),
        (of(reach=(1.26, 1.0)), "One and a half times the speaker's reach."),
        (of(reach=(1.0, 0.0)), ""),
        (of(hand_q90=(2.0, 1.0)), "Fast gestures at twice the speaker's speed."),
        (of(hand_q90=(1.25, 1.0)), ""),
        (of(calm_lively_r=0.4), ""),
        (of(calm_lively_r=0.39), "Calm and lively at other times than the speaker."),
        (of(sync=0.9), ""),
        (of(sync=(0.1, 0.1)), "In time with the speech."),
        (of(sync=(0.7, 1.0)), "In time with the speech."),
        (of(sync=(0.69, 1.0)), "Loosely in time with the speech."),
        (of(sync=(0.3, 1.0)), "Loosely in time with the speech."),
        (of(sync=(0.29, 1.0)), "Not in time with the speech."),
        (of(copying=(0.49, 1.0)), "Mostly copied from recordings."),
        (of(copying=(0.5, 1.0)), "Partly copied from recordings."),
        (of(copying=(0.79, 1.0)), "Partly copied from recordings."),
        (of(copying=(0.8, 1.0)), ""),
        (of(copying=(0.79, 1.0), reach=(0.7, 1.0)), "Two thirds of the speaker's reach."),
        (of(copying=(0.79, 1.0), reach=(0.8, 1.0)),
         "The speaker's reach, partly copied from recordings."),
        (of(copying_low=(0.59, 1.0), copying=(0.8, 1.0)), "Occasionally copied from recordings."),
        (of(copying_low=(0.6, 1.0)), ""),
    ],
)  # fmt: skip
def test_thresholds_of_the_verdict(metrics, said):
    assert verdict(metrics) == said


def test_the_verdict_takes_the_higher_level_of_chance():
    for levels in ({"chance": 0.5, "mismatched": 0.1}, {"chance": 0.1, "mismatched": 0.5}):
        # (0.8 - 0.5) of (1 - 0.5)
        found = {"sync": result("sync", 0.8, 1.0, **levels)}
        assert verdict(found) == "Loosely in time with the speech."


def test_likeness_of_several_weightings_is_that_of_each():
    """Measures that are no ratio: 1-NN of .8 and .7 against the usual .6 have half and 3/4."""
    made = [
        ClipResult(Pair(f"r{k}", f"r{k}", None, Path("a"), Path("b")), 9.0, {"one_nn": v}, {}, {})
        for k, v in enumerate((0.8, 0.7))
    ]
    measure = likeness_of(made, 0.6)
    assert measure(np.array([[1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])) == pytest.approx(
        [0.5, 0.75, 0.625]
    )
    assert measure(np.array([[1.0, 0.0], [0.5, 0.5]])) == pytest.approx([0.5, 0.625])


def test_likeness_without_a_value_of_the_recordings_is_measured_against_one():
    for value, state in ((0.85, "yes"), (0.84, "partly"), (0.6, "partly"), (0.59, "no")):
        found = states(clips(), likeness=result("likeness", value, None))
        assert found["likeness"][0] == state, value


@pytest.mark.parametrize(("count", "note"), [(5, True), (4, False)])
def test_the_likeness_of_a_model_has_the_levels_of_the_recordings(count, note):
    pairs = [Pair(f"r{r}", f"r{r}", None, Path("a"), Path("b")) for r in range(count)]
    factors = (1.0, 0.6, 0.5, 0.55, 0.7)
    made = [ClipResult(p, 9.0, {"reach": 0.3 * f}, {"reach": 0.3}, {})
            for p, f in zip(pairs, factors)]  # fmt: skip
    ceiling = Level(CEILING, 0.9, 0.05, 4, pieces=note)
    floor = Level("another speaker", 0.2, 0.2, 4)
    found = likeness_result(made, 0.6, {CEILING: ceiling, "another speaker": floor})
    mean = np.mean(factors[:count]) * 0.3
    ratio = np.log((0.3 + 0.005) / (mean + 0.005))
    expected = (np.log(2.5) - ratio) / (np.log(2.5) - np.log(1.25))
    assert found.interval.value == pytest.approx(expected)
    assert (found.interval.low is not None) == (count == 5)
    assert (found.ceiling, found.floors, found.recording) == (ceiling, (floor,), 0.9)
    what = "piece of one take against the others" if note else "take against the speaker's others"
    assert found.note == f"recording: each {what}"
    bare = likeness_result(made, 0.6, {"another speaker": floor})
    assert (bare.recording, bare.ceiling, bare.note) == (None, None, "")
    assert likeness_result([replace(one, metrics={}) for one in made], 0.6, {}) is None


def shown(*labels: str, informative: bool = True) -> Evaluation:
    """Models that answer one question each, with a floor and a ceiling."""
    floors = (Level("mean pose", 0.0, None, 0), Level("another speaker", 0.2, 0.05, 4))
    ceiling = Level(CEILING, 0.8, 0.1, 1, pieces=True)
    found = MetricResult("likeness", Interval(0.5, 0.4, 0.6, 6, 6, "takes"), 0.8, ceiling=ceiling,
                         floors=floors, informative=informative)  # fmt: skip
    models = []
    for label in labels:
        answer = Finding("Moves like this speaker?", "likeness", "partly", "Somewhat <so>.")
        made = ModelResult(label, Path(label), answers=[answer], metrics={"likeness": found})
        made.clips = [ClipResult(Pair("c", "c", None, Path("a"), Path("b")), 3.0, {}, {}, {})]
        models.append(made)
    return Evaluation(models, Path("r"), 25.0, "", {"variants": {}}, SpeedHistogram(), np.zeros(0))


LEVELS = (
    "floor: mean pose 0, another speaker 0.20 ± 0.05 (4 takes); ceiling: pieces of one take, more "
    "alike than takes are 0.80 ± 0.10 (1 piece)"
)


def test_a_line_of_a_terminal_has_the_answer_its_interval_and_its_levels():
    text = f"Moves like this speaker? Somewhat <so>. (0.50; 95 % interval 0.40 to 0.60; {LEVELS})"
    assert headline_lines(shown("a")) == [text]
    assert headline_lines(shown("a", "b")) == [f"a: {text}", f"b: {text}"]
    silent = shown("a", informative=False)
    assert headline_lines(silent) == ["Moves like this speaker? Somewhat <so>."]
    silent.models[0].metrics.clear()
    assert headline_lines(silent) == ["Moves like this speaker? Somewhat <so>."]
    bare = shown("a")
    bare.models[0].metrics["likeness"] = result("likeness", 0.5, None)
    assert headline_lines(bare)[0].endswith("(0.50; no interval)")


def test_the_page_shows_the_score_on_its_line_in_the_models_colour():
    found = shown("a", "b")
    page = headline(found, {"likeness": Contest("likeness", 0.8, {}, "reference", best="b")})
    assert page.count("<span class=best>0.50</span>") == 1 and page.count(">0.50</span>") == 2
    assert page.index(">b<") < page.index("class=best")
    assert page.count("Somewhat &lt;so&gt;.") == 2
    assert page.count("<small>95 % interval 0.40 to 0.60</small>") == 2
    dots = re.findall(r'<circle cx="([\d.]+)" cy="15" r="5" style="fill:(#\w+)"/>', page)
    # From 0 to the end of the ceiling's band at 0.9, on 248 pixels from 6 on.
    assert [float(x) for x, _ in dots] == pytest.approx([6 + 248 * 0.5 / 0.9] * 2, abs=0.06)
    assert [ink for _, ink in dots] == [colour(0), colour(1)]
    bands = [tuple(map(float, b)) for b in re.findall(r'<rect x="([\d.]+)" width="([\d.]+)"', page)]
    scale = 248 / 0.9
    assert bands[:3] == [
        pytest.approx((6, 0), abs=0.06),
        pytest.approx((6 + 0.15 * scale, 0.1 * scale), abs=0.06),
        pytest.approx((6 + 0.7 * scale, 0.2 * scale), abs=0.06),
    ]
    assert re.findall(r'<g class="(\w+)">', page)[:3] == ["floor", "floor", "ceiling"]
    assert 'class="floor">floor: mean pose 0; another speaker 0.20 ± 0.05 (4 takes)</small>' in page
    silent = headline(shown("a", informative=False), {})
    assert "<circle" not in silent and "class=best" not in silent and silent.count("<svg") == 1
    none = shown("a")
    none.models[0].answers.clear()
    assert headline(none, {}) == ""


def test_takes_that_are_missing_are_asked_for_once_or_by_model():
    (warning,) = interval_warnings(shown("a", "b"))
    assert warning.startswith("the clips come from 1 take: no intervals") and "a: " not in warning
    assert warning.endswith("Hold out 5 or more takes")
    found = shown("a", "b")
    found.models[1].clips += [
        replace(found.models[1].clips[0], pair=Pair("d", "d", None, Path("a"), Path("b")))
    ]
    one, two = interval_warnings(found)
    assert one.startswith("a: the clips come from 1 take:")
    assert two.startswith("b: the clips come from 2 takes:")
    for model in found.models:
        model.clips = [replace(model.clips[0], pair=Pair(c, c, None, Path("a"), Path("b")))
                       for c in "pqrst"]  # fmt: skip
    assert list(interval_warnings(found)) == []
