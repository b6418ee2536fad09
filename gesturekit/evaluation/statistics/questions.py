"""Three questions that head a report, answered in one sentence each, and the verdict in words.

The verdict is one line, such as "Half of the speaker's reach, hardly ever at rest, in time with the
speech." All thresholds are in `thresholds`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.metrics.two_sample import ARM_KEYS
from gesturekit.evaluation.results import (
    NOT_ASKED,
    ClipResult,
    Level,
    MetricResult,
    ModelResult,
    QuestionAnswer,
)
from gesturekit.evaluation.statistics import thresholds
from gesturekit.evaluation.statistics.levels import (
    add_speech_blind_floors,
    least_likeness,
    level_text,
    mark_reached_floors,
    on_its_floor,
    reached_floor,
)
from gesturekit.evaluation.statistics.likeness import ASPECTS, aspects_of
from gesturekit.evaluation.statistics.model_metrics import above_chance
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
    add_speech_blind_floors(models)
    mark_reached_floors(models)
    for model in models:
        model.answers = answers_of(model.clips, model.metrics)
        model.verdict = verdict(model.metrics)


def answers_of(clips: Sequence[ClipResult], metrics: Results) -> list[QuestionAnswer]:
    """Return the answers to the three questions.

    Args:
        clips: the clips of a model.
        metrics: its results by key of `definitions`.
    """
    if broken := defects(metrics):
        why = f"Not asked, as the motion is {broken}."
        return [QuestionAnswer(text, key, NOT_ASKED, why) for key, text in QUESTIONS.items()]
    found = (_timing(clips, metrics), _likeness(metrics), _novelty(clips, metrics))
    return [
        QuestionAnswer(text, key, state, _with_level(sentence, metrics.get(key)))
        for (key, text), (state, sentence) in zip(QUESTIONS.items(), found, strict=True)
    ]


def _with_level(sentence: str, result: MetricResult | None) -> str:
    """Return an answer that says where its score is above the ceiling or no higher than a floor."""
    if result is None or not result.informative:
        return sentence
    floor, ceiling, value = on_its_floor(result), result.ceiling, result.interval.value
    if floor is not None:
        text = f"no higher than its floor, {level_text(floor)}"
    elif result.key != "novelty" and ceiling is not None and _is_above(value, ceiling):
        text = f"above its ceiling, {level_text(ceiling)}"
    else:
        return sentence
    return f"{sentence.removesuffix('.')}; {text}."


def _is_above(value: float, ceiling: Level | None) -> bool:
    """Return whether a score is above the ceiling by more than its spread."""
    return ceiling is not None and value > ceiling.value + (ceiling.spread or 0.0)


def _cannot_be_answered(why: str) -> tuple[str, str]:
    return UNANSWERABLE, f"Cannot be answered on this corpus: {why}"


def _no_room(result: MetricResult) -> str:
    """Return in words that a floor reaches the ceiling; "" if none does."""
    floor = reached_floor(result)
    if floor is None or result.ceiling is None:
        return ""
    ceiling = level_text(result.ceiling)
    return f"the floor, {level_text(floor)}, is not surely below the ceiling, {ceiling}."


def defects(metrics: Results) -> str:
    """Return in words what is broken about a motion, whatever else is measured; "" if nothing.

    Rotations that are not so far beyond the recordings' range, in motion that is nowhere near the
    recorded one, may be those of another speaker as well.
    """

    def value(key: str) -> float | None:
        result = metrics.get(key)
        return None if result is None else result.interval.value

    def own(key: str) -> float:
        return (metrics[key].recording if key in metrics else None) or 0.0

    found, what = [], "broken"
    beyond, apart, covered = value("joint_limits"), value("one_nn"), value("within_reach")
    more = 0.0 if beyond is None else beyond - own("joint_limits")
    alien = apart is not None and apart >= thresholds.SEPARABLE > own("one_nn")
    empty = covered is not None and covered < thresholds.COVERED * own("within_reach")
    if more > (thresholds.FAR_BEYOND_LIMITS if alien and empty else thresholds.BEYOND_LIMITS):
        found.append(f"{beyond:.0f} % of joint rotations are beyond the recordings' range")
        what = "broken" if more > thresholds.BEYOND_LIMITS else "broken, or another speaker's"
    for key, limit, text in (
        ("feet_above_floor", thresholds.FLOATING, "the feet are {:.0f} mm above the floor"),
        ("bone_length_change", thresholds.STRETCHED, "bones change their length by {:.0f} %"),
    ):
        if (value(key) or 0.0) - 2.0 * own(key) > limit:
            found.append(text.format(value(key)))
            what = "broken"
    shaken = _ratio(metrics, "jerk_genea")
    if shaken is not None and shaken > thresholds.SHAKEN:
        found.append(f"it shakes ({shaken:.0f} times the recordings' jerk)")
        what = "broken"
    return f"{what}: {', '.join(found)}" if found else ""


def _timing(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    """Return state and sentence of the first answer."""
    result = metrics.get("in_time")
    if result is None or result.recording is None:
        return "not measured", "Not measured: no speech with arms to move."
    if not result.informative:
        return _timing_without_recordings(clips, metrics)
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
    if share > thresholds.TOO_STRICT:
        text = "In time with the speech, more strictly than the speaker."
        return "partly", text
    return "yes", "As much in time with the speech as the speaker."


def _timing_without_recordings(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    """Return whether a model is above its own chance level, where recordings give no measure."""
    result = metrics["in_time"]
    if no_room := _no_room(result):
        return _cannot_be_answered(no_room)
    seconds = sum({c.pair.of: c.seconds for c in clips}.values())
    few = (
        f"{seconds:.0f} s of speech are too few, or move the speaker's arms too little, to say "
        "whether as much as the speaker"
    )
    if _above_chance(metrics):
        text = f"In time with the speech more than by chance; {few}."
        return "partly", text
    text = f"Not in time with the speech more than by chance; {few}."
    return UNANSWERABLE, text


def _above_chance(metrics: Results) -> bool:
    """Return whether a model's own sync is above its chance level."""
    low, sds = metrics["in_time"].interval.low, metrics.get("sync_z")
    if low is not None:
        return low > 0.0
    return sds is not None and sds.interval.value >= thresholds.ABOVE_CHANCE


def _likeness(metrics: Results) -> tuple[str, str]:
    result = metrics.get("likeness")
    if result is None:
        text = "Not measured: no body parts to compare, or fewer than three clips of the speaker."
        return "not measured", text
    if not result.informative:
        few = "takes of this speaker are too unlike one another, or too short, to compare with."
        return _cannot_be_answered(_no_room(result) or few)
    value = result.interval.value
    untested = "" if result.tested_against_speaker else "; not tested against another speaker"
    if value >= least_likeness(result.ceiling) and on_its_floor(result) is None:
        return "yes", f"Moves like this speaker{untested}."
    aspects = aspects_of(result.groups)
    missed = sorted(
        (a for a in aspects if aspects[a] < thresholds.NAMED_ASPECT), key=aspects.__getitem__
    )
    differs = f"; what differs: {listed(missed, len(ASPECTS))}" if missed else ""
    differs += _speakers(result) + untested
    if value >= thresholds.LEAST_PARTLY_LIKE and on_its_floor(result) is None:
        return "partly", f"Moves somewhat like this speaker{differs}."
    return "no", f"Does not move like this speaker{differs}."


def _speakers(result: MetricResult) -> str:
    """Return the likeness to each speaker in words, if they differ; else ""."""
    found = {group.name: group.value for group in result.groups}
    if max(found.values(), default=0.0) - min(found.values(), default=0.0) < (
        thresholds.SPEAKERS_DIFFER
    ):
        return ""
    each = [f"{name or 'unnamed'} {value:.2f}" for name, value in found.items()]
    return f"; it differs between speakers: {listed(each, 6)}"


def _novelty(clips: Sequence[ClipResult], metrics: Results) -> tuple[str, str]:
    result, still = metrics.get("novelty"), metrics.get("near_still")
    if still is not None and still.interval.value >= thresholds.MOTIONLESS:
        text = "the hands hardly move, and what does not move is near to any motion."
        return _cannot_be_answered(text)
    if result is None:
        splits = {getattr(getattr(c.pair.reference, "item", None), "split", "") for c in clips}
        text = "the clips are too short, or the rig's arms and legs are not known."
        if splits == {"train"}:
            text = "these are the recordings that the model was trained on; evaluate others."
        elif "one_nn" in metrics:
            text = "no training motion is given; name a manifest that has a training split."
        return "not measured", f"Not asked: {text}"
    if not result.informative:
        text = (
            "the recordings themselves are the same as training motion, or do not move. Look for "
            "one recording in two splits."
        )
        return _cannot_be_answered(text)
    ratios = {f"the {side} arm": _ratio(metrics, key) for side, key in ARM_KEYS.items()}
    arms = [arm for arm, ratio in ratios.items() if ratio is not None and ratio < thresholds.COPIED]
    seeds = _seeds(metrics)
    if result.interval.value < thresholds.COPIED:
        return "no", f"Mostly copied from training motion{seeds}."
    if arms:
        text = f"Mostly copied from training motion: {' and '.join(arms)}{seeds}."
        return "no", text
    if result.interval.value < thresholds.NEAR:
        text = "Nearer to training motion than other recordings are: partly copied, or less lively"
        return "no", f"{text}{seeds}."
    lowest = _ratio(metrics, "copying_low")
    if lowest is not None and lowest < thresholds.OCCASIONALLY_COPIED:
        text = f"New, but occasionally copied from training motion{seeds}."
        return "partly", text
    text = "New: as far from training motion as other recordings"
    if _is_above(result.interval.value, result.ceiling):
        text = "New: farther from training motion than other recordings, as odd motion is too"
    return "yes", f"{text}{seeds}."


def _seeds(metrics: Results) -> str:
    """Return how much the samples of one recording differ, in words; "" with one sample."""
    result = metrics.get("inter_diversity")
    if result is None or not result.recording:
        return ""
    share = result.interval.value / result.recording
    return f"; two samples of one speech differ {100 * share:.0f} % as much as two recordings do"


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


def verdict(metrics: Mapping[str, MetricResult]) -> str:
    """Return a sentence on reach, speed, rests, timing, copying, likeness; "" if nothing is known.

    Args:
        metrics: results of a model by key of `definitions`, each with the recording's value.
    """
    still = metrics.get("near_still")
    if still is not None and still.interval.value >= thresholds.MOTIONLESS:
        return "The hands hardly move."
    if broken := defects(metrics):
        return f"The motion is {broken}."
    phrases = [
        *_movement_words(metrics),
        *_rest_words(metrics),
        *_timing_words(metrics),
        *_copying_words(metrics),
        *_likeness_words(metrics),
    ]
    text = ", ".join(phrases)
    return f"{text[0].upper()}{text[1:]}." if text else ""


def same_verdicts(models: Sequence[ModelResult]) -> Iterator[str]:
    """Yield in what models with the same verdict differ, a sentence for each such verdict.

    Metrics are named whose intervals do not overlap for the two models that are farthest apart.
    """
    alike: dict[str, list[ModelResult]] = {}
    for model in models:
        alike.setdefault(model.verdict, []).append(model)
    for verdict_, same in alike.items():
        if not verdict_ or len(same) < 2:
            continue
        differ = []
        for key, definition in DEFINITIONS.items():
            results = [m.metrics[key] for m in same if key in m.metrics]
            known = [r.interval for r in results if r.informative and r.interval.low is not None]
            least = min(known, key=lambda one: one.value, default=None)
            most = max(known, key=lambda one: one.value, default=None)
            if least is None or most is None or least.high is None or most.low is None:
                continue
            if least.high < most.low:
                differ.append(f"{definition.name} ({least.value:.3g} to {most.value:.3g})")
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


def _movement_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    said = {"reach": "has {}the speaker's reach"}
    said["hand_q90"] = "its fast gestures have {}the speaker's speed"
    for key, text in said.items():
        if (ratio := _ratio(metrics, key)) is not None:
            alike = _within(ratio, thresholds.ALIKE)
            yield text.format("" if alike else f"{in_words(ratio)} ")


def _rest_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    rest, still = metrics.get("rest"), metrics.get("near_still")
    if still is not None and still.interval.value > (still.recording or 0.0) + thresholds.FROZEN:
        yield f"its hands are frozen in {still.interval.value:.0f} % of the time"
    elif rest is not None and rest.recording and rest.recording >= thresholds.FEW_RESTS:
        ratio = rest.interval.value / rest.recording
        if ratio < thresholds.HARDLY_EVER:
            yield "is hardly ever at rest"
        elif ratio < thresholds.RESTS_ALIKE[0]:
            yield "is seldom at rest"
        elif ratio > thresholds.RESTS_ALIKE[1]:
            yield "is at rest more of the time than the speaker"
        else:
            yield "is at rest as much of the time as the speaker"


def _timing_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    calm, sync = metrics.get("calm_lively_r"), metrics.get("sync")
    if calm is not None and calm.informative and calm.interval.value < thresholds.FOLLOWS:
        yield "is calm and lively at other times than the speaker"
    if sync is None or sync.recording is None:
        return
    levels = [level for level in (sync.mismatched, sync.chance) if level is not None]
    chance = max(levels, default=0.0)
    ours, own = sync.interval.value - chance, sync.recording - chance
    if own < thresholds.LEAST_SYNC or not sync.informative:
        if "in_time" in metrics and _above_chance(metrics):
            yield "is in time with the speech more than by chance"
    elif ours >= thresholds.IN_TIME * own:
        yield "is in time with the speech"
    elif ours >= thresholds.LOOSELY_IN_TIME * own:
        yield "is loosely in time with the speech"
    else:
        yield "is not in time with the speech"


def _copying_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    median, low = _ratio(metrics, "copying"), _ratio(metrics, "copying_low")
    if median is not None and median < thresholds.COPIED:
        yield "is mostly copied from recordings"
    elif (_ratio(metrics, "reach") or 1.0) < thresholds.ALIKE[0]:
        return  # small motion is near to any
    elif median is not None and median < thresholds.NEAR:
        yield "is partly copied from recordings"
    elif low is not None and low < thresholds.OCCASIONALLY_COPIED:
        yield "is occasionally copied from recordings"


_LIKENESS_WORDS = {
    "yes": "moves like the speaker",
    "partly": "moves only somewhat like the speaker",
    "no": "does not move like the speaker",
}


def _likeness_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    state, _ = _likeness(metrics)
    if state in _LIKENESS_WORDS:
        yield _LIKENESS_WORDS[state]


def _ratio(metrics: Mapping[str, MetricResult], key: str) -> float | None:
    """Return a value over the recording's; None without either."""
    result = metrics.get(key)
    if result is None or not result.recording:
        return None
    return result.interval.value / result.recording


def _within(ratio: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= ratio <= limits[1]
