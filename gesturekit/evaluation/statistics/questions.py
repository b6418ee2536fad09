"""Three questions that head a report, answered in one sentence each, and the verdict in words.

The verdict is one line, such as "Has half of the speaker's reach, is hardly ever at rest, is
loosely in time with the speech.": words on the movement, then the first clause of each answer.
All thresholds are in `thresholds`.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.metrics.two_sample import ARM_KEYS
from gesturekit.evaluation.results import (
    NOT_ASKED,
    ClipResult,
    MetricResult,
    ModelResult,
    QuestionAnswer,
)
from gesturekit.evaluation.statistics import thresholds
from gesturekit.evaluation.statistics.likeness import ASPECTS, aspects_of
from gesturekit.evaluation.statistics.model_metrics import (
    above_chance,
    add_floors,
    least_likeness,
    level_name,
    level_text,
    on_its_floor,
    reached_floor,
    seconds_of,
)
from gesturekit.wording import listed

QUESTIONS = {
    "in_time": "In time with the speech?",
    "likeness": "Moves like this speaker?",
    "novelty": "Is it new?",
}
"""Questions by the key of their metric."""
UNANSWERABLE = "cannot be answered"
Results = Mapping[str, MetricResult]


def answer_questions(models: Sequence[ModelResult]) -> None:
    """Give each model answers and a verdict; models that ignore speech are floors of timing."""
    add_floors(models)
    for model in models:
        model.answers = answers_of(model.clips, model.metrics)
        model.verdict = verdict(model.metrics, model.answers)


def answers_of(clips: Sequence[ClipResult], metrics: Results) -> list[QuestionAnswer]:
    """Return the answers to the three questions.

    Args:
        clips: the clips of a model.
        metrics: its results by key of `definitions`.
    """
    if broken := defects(metrics):
        why = f"Not asked, as the motion is {broken}."
        return [QuestionAnswer(text, key, NOT_ASKED, why) for key, text in QUESTIONS.items()]
    found = (_timing(clips, metrics), _likeness(clips, metrics), _novelty(clips, metrics))
    return [
        QuestionAnswer(text, key, state, _with_level(sentence, metrics.get(key)))
        for (key, text), (state, sentence) in zip(QUESTIONS.items(), found, strict=True)
    ]


def _with_level(sentence: str, result: MetricResult | None) -> str:
    """Return an answer that says where its score is above the ceiling or no higher than a floor."""
    if result is None or not result.informative:
        return sentence
    if floor := on_its_floor(result):
        text = f"no higher than its floor, {level_name(floor)}"
    elif result.ceiling is not None and result.key == "in_time" and _is_above_ceiling(result):
        text = f"above its ceiling, {level_name(result.ceiling)}"
    else:
        return sentence
    return f"{sentence.removesuffix('.')}; {text}."


def _is_above_ceiling(result: MetricResult) -> bool:
    """Return whether a score is above the ceiling by more than its spread."""
    ceiling = result.ceiling
    return ceiling is not None and (result.interval.value > ceiling.value + (ceiling.spread or 0.0))


def _cannot_be_answered(why: str) -> tuple[str, str]:
    return UNANSWERABLE, f"Cannot be answered on this corpus: {why}"


def _no_room(result: MetricResult) -> str:
    """Return in words that a floor reaches the ceiling; "" if none does."""
    floor = reached_floor(result)
    if floor is None or result.ceiling is None:
        return ""
    ceiling = level_text(result.ceiling)
    return f"the floor, {level_text(floor)}, is not surely below the ceiling, {ceiling}."


def _value(metrics: Results, key: str) -> float:
    """Return a value of the model, NaN without one."""
    return metrics[key].interval.value if key in metrics else math.nan


def _own(metrics: Results, key: str) -> float:
    """Return the recordings' own value, 0 without one."""
    return (metrics[key].recording if key in metrics else None) or 0.0


def _ratio(metrics: Results, key: str) -> float:
    """Return a value over the recordings' own, NaN without either."""
    return _value(metrics, key) / (_own(metrics, key) or math.nan)


_DEFECTS = {
    "joint_limits": (
        1.0,
        thresholds.BEYOND_LIMITS,
        "{:.0f} % of joint rotations are beyond the recordings' range",
    ),
    "worst_joint": (
        1.0,
        thresholds.OUT_OF_JOINT,
        "one joint is far beyond the recordings' range in {:.0f} % of the frames",
    ),
    "feet_above_floor": (2.0, thresholds.FLOATING, "the feet are {:.0f} mm above the floor"),
    "floor_penetration": (2.0, thresholds.SUNK, "the feet are {:.0f} mm below the floor"),
    "foot_skate": (2.0, thresholds.SLIDING, "the feet slide at {:.2f} m/s"),
    "bone_length_change": (2.0, thresholds.STRETCHED, "bones change their length by {:.0f} %"),
}
"""Metrics of a broken body: factor of the recordings' own value, what the model has more than that
product, and the words for it."""


def defects(metrics: Results) -> str:
    """Return in words what is broken about a motion, whatever else is measured; "" if nothing.

    Rotations that are not so far beyond the recordings' range, in motion that is nowhere near the
    recorded one, may be those of another speaker as well.
    """
    found = [
        words.format(_value(metrics, key))
        for key, (times, more, words) in _DEFECTS.items()
        if key in metrics
        and metrics[key].informative
        and _value(metrics, key) - times * _own(metrics, key) > more
    ]
    if (shaken := _ratio(metrics, "jerk_genea")) > thresholds.SHAKEN:
        found.append(f"it shakes ({shaken:.0f} times the recordings' jerk)")
    if found:
        return f"broken: {', '.join(found)}"
    beyond = _value(metrics, "joint_limits")
    alien = _value(metrics, "one_nn") >= thresholds.SEPARABLE > _own(metrics, "one_nn")
    alien &= _value(metrics, "within_reach") < thresholds.COVERED * _own(metrics, "within_reach")
    if alien and beyond - _own(metrics, "joint_limits") > thresholds.FAR_BEYOND_LIMITS:
        words = _DEFECTS["joint_limits"][-1].format(beyond)
        return f"broken, or another speaker's: {words}"
    return ""


def _timing(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    """Return state and sentence of the first answer."""
    result = metrics.get("in_time")
    if result is None or result.recording is None:
        silent = all(clip.pair.audio is None for clip in clips)
        unknown = "the rig's arms are not known, or there is too little speech"
        return "not measured", f"Not measured: {'there is no sound' if silent else unknown}."
    if not result.informative:  # the model alone is asked: is it above its own chance level?
        if no_room := _no_room(result):
            return _cannot_be_answered(no_room)
        seconds = f"{seconds_of(clips):.0f} s of speech"
        few = f"{seconds} are too few, or move the speaker's arms too little"
        if _above_chance(metrics):
            words = "In time with the speech more than by chance; whether as much as the speaker"
            return "partly", f"{words} cannot be said: {few}."
        return _cannot_be_answered(f"{few}.")
    low = result.interval.low
    share = result.interval.value / result.recording
    if low is None:
        lucky = "sync" in metrics and not above_chance(clips, "sync", of_recordings=False)
    else:
        lucky = low <= 0.0 and share < thresholds.IN_TIME
    if share < thresholds.LOOSELY_IN_TIME or lucky or on_its_floor(result):
        return "no", "Not in time with the speech."
    if share < thresholds.IN_TIME:
        return "partly", "Loosely in time with the speech."
    lag = _value(metrics, "sync_lag") - _own(metrics, "sync_lag")
    if abs(lag) >= thresholds.LATE:
        words = f"{abs(lag):.1f} s {'later' if lag > 0.0 else 'earlier'} than the speaker"
        return "partly", f"In time with the speech, but {words}."
    if share > thresholds.TOO_STRICT:
        return "partly", "In time with the speech, more strictly than the speaker."
    return "yes", "As much in time with the speech as the speaker."


def _above_chance(metrics: Results) -> bool:
    """Return whether a model's own sync is above its chance level."""
    low = metrics["in_time"].interval.low if "in_time" in metrics else -math.inf
    return _value(metrics, "sync_z") >= thresholds.ABOVE_CHANCE if low is None else low > 0.0


def _likeness(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    result = metrics.get("likeness")
    if result is None:
        return "not measured", (
            "Not measured: no body parts to compare, or fewer than three clips of the speaker."
        )
    if (seconds := seconds_of(clips)) < thresholds.LEAST_SECONDS:
        return _cannot_be_answered(f"{seconds:.0f} s of motion are too few.")
    if not result.informative:
        few = "takes of this speaker are too unlike one another, or too short, to compare with."
        return _cannot_be_answered(_no_room(result) or few)
    value = math.nan if on_its_floor(result) else result.interval.value
    untested = "" if result.tested_against_speaker else "; not tested against another speaker"
    if value >= least_likeness(result.ceiling):
        return "yes", f"Moves like this speaker{untested}."
    aspects = aspects_of(result.groups)
    missed = sorted(
        (a for a in aspects if aspects[a] < thresholds.NAMED_ASPECT), key=aspects.__getitem__
    )
    differs = f"; what differs: {listed(missed, len(ASPECTS))}" if missed else ""
    speakers = {group.name or "unnamed": group.value for group in result.groups}
    if speakers and np.ptp([*speakers.values()]) >= thresholds.SPEAKERS_DIFFER:
        each = [f"{name} {likeness:.2f}" for name, likeness in speakers.items()]
        differs += f"; it differs between speakers: {listed(each, 6)}"
    if value >= thresholds.LEAST_PARTLY_LIKE:
        return "partly", f"Moves somewhat like this speaker{differs}{untested}."
    return "no", f"Does not move like this speaker{differs}{untested}."


def _novelty(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    result = metrics.get("novelty")
    if _value(metrics, "near_still") >= thresholds.MOTIONLESS:
        return _cannot_be_answered(
            "the hands hardly move, and what does not move is near to any motion."
        )
    if result is None:
        splits = {c.pair.reference.split for c in clips}
        text = "the clips are too short, or the rig's arms and legs are not known."
        if splits == {"train"}:
            text = "these are the recordings that the model was trained on; evaluate others."
        elif "one_nn" in metrics:
            text = "no training motion is given; name a manifest that has a training split."
        return "not measured", f"Not asked: {text}"
    if not result.informative:
        return _cannot_be_answered(
            "the recordings themselves are the same as training motion, or do not move. Look for "
            "one recording in two splits."
        )
    # Arms are also compared with the other one of training: the calmer one is the measure of both.
    own = min(filter(None, (_own(metrics, key) for key in ARM_KEYS.values())), default=0.0)
    nearest = {side: _value(metrics, key) for side, key in ARM_KEYS.items()}
    copied = [f"the {side} arm" for side in nearest if nearest[side] < thresholds.COPIED * own]
    value, share = result.interval.value, 100 * _ratio(metrics, "inter_diversity")
    seeds = "" if math.isnan(share) else (
        f"; two samples of one speech differ {share:.0f} % as much as two recordings do"
    )  # fmt: skip
    if value < thresholds.COPIED:
        return "no", f"Mostly copied from training motion{seeds}."
    if copied:
        return "no", f"Mostly copied from training motion in {' and '.join(copied)}{seeds}."
    if value < thresholds.NEAR:
        text = "Partly copied from training motion, or less lively than the speaker; nearer to it"
        return "no", f"{text} than other recordings are{seeds}."
    if _ratio(metrics, "copying_low") < thresholds.OCCASIONALLY_COPIED:
        return "partly", f"New, but occasionally copied from training motion{seeds}."
    text = "New: as far from training motion as other recordings"
    if _is_above_ceiling(result):
        text = "New: farther from training motion than other recordings, as odd motion is too"
    return "yes", f"{text}{seeds}."


_RATIO_WORDS = {
    0.1: "a tenth of",
    0.25: "a quarter of",
    1 / 3: "a third of",
    0.5: "half of",
    2 / 3: "two thirds of",
    0.75: "three quarters of",
    1.5: "one and a half times",
    2.0: "twice",
    3.0: "three times",
    4.0: "four times",
}


def verdict(metrics: Results, answers: Sequence[QuestionAnswer]) -> str:
    """Return a sentence on reach, speed, rests and the answers; "" if nothing is known.

    Args:
        metrics: results of a model by key of `definitions`, each with the recordings' value.
        answers: those of `answers_of`; that a motion is new is no praise, since odd motion is too.
    """
    if _value(metrics, "near_still") >= thresholds.MOTIONLESS:
        return "The hands hardly move."
    if broken := defects(metrics):
        return f"The motion is {broken}."
    words = [*_movement_words(metrics)]
    for answer in answers:
        is_praise = answer.state == "yes" and answer.key != "novelty"
        if is_praise or answer.state in ("partly", "no"):
            clause = answer.sentence.partition(";")[0].removesuffix(".")
            verb = "" if answer.key == "likeness" else "is "
            words.append(f"{verb}{clause[0].lower()}{clause[1:]}")
    text = ", ".join(words)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def same_verdicts(models: Sequence[ModelResult]) -> Iterator[str]:
    """Yield in what models with the same verdict differ, a sentence for each such verdict.

    Metrics are named whose intervals do not overlap for the two models that are farthest apart.
    """
    alike: dict[str, list[ModelResult]] = {}
    for model in models:
        alike.setdefault(model.verdict, []).append(model)
    for same in (same for words, same in alike.items() if words and len(same) > 1):
        differ = []
        for key, definition in DEFINITIONS.items():
            results = [m.metrics[key] for m in same if key in m.metrics]
            intervals = [result.interval for result in results if result.informative]
            known = [
                (one.value, one.low, one.high)
                for one in intervals if one.low is not None and one.high is not None
            ]  # fmt: skip
            if known and min(known)[2] < max(known)[1]:
                differ.append(f"{definition.name} ({min(known)[0]:.3g} to {max(known)[0]:.3g})")
        names = listed([model.label for model in same])
        if differ:
            yield f"{names} have one verdict; they differ in {listed(differ, 3)}."
        else:
            yield f"{names} have one verdict, and no metric tells them apart with certainty."


def in_words(ratio: float) -> str:
    """Return a ratio other than 1 in words, such as "half of"; the nearest one with a name."""
    if ratio < 0.07:
        return "next to nothing of"
    if ratio > 5.0:
        return "many times"
    return _RATIO_WORDS[min(_RATIO_WORDS, key=lambda named: abs(np.log(named / ratio)))]


def _movement_words(metrics: Results) -> Iterator[str]:
    """Yield words on reach, speed, rests, and calm and lively stretches."""
    low, high = thresholds.ALIKE
    for key, before, after in (
        ("reach", "has ", "the speaker's reach"),
        ("hand_q90", "its fast gestures have ", "the speaker's speed"),
    ):
        if not math.isnan(ratio := _ratio(metrics, key)):
            yield f"{before}{'' if low <= ratio <= high else f'{in_words(ratio)} '}{after}"
    still = _value(metrics, "near_still")
    if still > _own(metrics, "near_still") + thresholds.FROZEN:
        yield f"its hands are frozen in {still:.0f} % of the time"
    elif _own(metrics, "rest") >= thresholds.FEW_RESTS:
        limits = (thresholds.HARDLY_EVER, *thresholds.RESTS_ALIKE)
        yield (
            "is hardly ever at rest",
            "is seldom at rest",
            "is at rest as much of the time as the speaker",
            "is at rest more of the time than the speaker",
        )[bisect_right(limits, _ratio(metrics, "rest"))]
    calm = metrics.get("calm_lively_r")
    if calm is not None and calm.informative and calm.interval.value < thresholds.FOLLOWS:
        yield "is calm and lively at other times than the speaker"
