"""Three questions that head a report, answered in one sentence each, and the verdict in words.

The verdict is one line, such as "Half of the speaker's reach, hardly ever at rest, in time with the
speech." All thresholds are in `thresholds`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.results import ClipResult, Finding, Level, MetricResult, ModelResult
from gesturekit.evaluation.statistics import thresholds
from gesturekit.evaluation.statistics.groups import by_group
from gesturekit.evaluation.statistics.intervals import (
    FEW,
    Takes,
    interval_about,
    pseudo_values,
)
from gesturekit.evaluation.statistics.levels import (
    CEILING,
    add_blind_floors,
    level_text,
    on_its_floor,
    reached_floor,
)
from gesturekit.evaluation.statistics.likeness import (
    ASPECTS,
    MEASURES,
    TWO_SAMPLE,
    credits,
    likeness,
)
from gesturekit.wording import listed

IN_TIME, LIKE, NEW = (
    "In time with the speech?",
    "Moves like this speaker?",
    "Is it new?",
)
UNANSWERABLE = "cannot be answered"
OTHER_TAKES = "sets of the speaker's takes against other sets"
Results = Mapping[str, MetricResult]


def answer(models: Sequence[ModelResult]) -> None:
    """Answer the three questions for each model; models that ignore speech are floors of timing."""
    add_blind_floors(models, _timing_by_take)
    for model in models:
        model.answers = answers(model.clips, model.metrics)


def _timing_by_take(model: ModelResult) -> np.ndarray:
    clips = [clip for clip in model.clips if "in_time" in clip.metrics]
    return Takes.of([c.pair for c in clips]).means([c.metrics["in_time"] for c in clips])


def answers(clips: Sequence[ClipResult], metrics: Results) -> list[Finding]:
    """Return the answers to the three questions.

    Args:
        clips: the clips of a model.
        metrics: its results by key of `definitions`.
    """
    if broken := defects(metrics):
        why = f"the motion is broken: {', '.join(broken)}."
        return [
            Finding(question, key, "no", f"Not asked, as {why}")
            for question, key in ((IN_TIME, "in_time"), (LIKE, "likeness"), (NEW, "novelty"))
        ]
    found = [_timing(clips, metrics), _likeness(clips, metrics), _novelty(metrics)]
    return [_on_its_line(finding, metrics.get(finding.key)) for finding in found]


def _on_its_line(finding: Finding, result: MetricResult | None) -> Finding:
    """Return a finding that says where its score is above the ceiling or no higher than a floor."""
    if result is None or not result.informative:
        return finding
    floor, ceiling, value = on_its_floor(result), result.ceiling, result.interval.value
    if floor is not None:
        text = f"no higher than its floor, {level_text(floor)}"
    elif finding.key != "novelty" and ceiling is not None and _is_above(value, ceiling):
        text = f"above its ceiling, {level_text(ceiling)}"
    else:
        return finding
    return replace(finding, sentence=f"{finding.sentence.removesuffix('.')}; {text}.")


def _is_above(value: float, ceiling: Level | None) -> bool:
    """Return whether a score is above the ceiling by more than its spread."""
    return ceiling is not None and value > ceiling.value + (ceiling.spread or 0.0)


def _cannot_be_answered(question: str, key: str, why: str) -> Finding:
    return Finding(question, key, UNANSWERABLE, f"Cannot be answered on this corpus: {why}")


def _no_room(result: MetricResult) -> str:
    """Return in words that a floor reaches the ceiling; "" if none does."""
    floor = reached_floor(result)
    if floor is None or result.ceiling is None:
        return ""
    ceiling = level_text(result.ceiling)
    return f"the floor, {level_text(floor)}, is not surely below the ceiling, {ceiling}."


def likeness_result(
    clips: Sequence[ClipResult], levels: Mapping[str, Level]
) -> MetricResult | None:
    """Return the likeness of a model's clips with its interval over takes.

    Args:
        clips: the clips.
        levels: ceiling and floors by name, see `statistics.levels`.
    """
    measure = likeness_of(clips)
    takes = Takes.of([clip.pair for clip in clips])
    value = float(measure(np.full((1, takes.count), 1 / takes.count))[0])
    if np.isnan(value):
        return None
    # Where credits saturate, the spread of takes says nothing.
    enough = takes.count >= FEW and value < thresholds.SATURATED
    units = pseudo_values(measure, takes.count) if enough else np.full(takes.count, value)
    interval = interval_about(value, units, takes, DEFINITIONS["likeness"].within)
    ceiling = levels.get(CEILING)
    floors = tuple(level for name, level in levels.items() if name != CEILING)
    if ceiling is None:
        return MetricResult("likeness", interval, floors=floors)
    note = f"recording: {'pieces of one take' if ceiling.pieces else OTHER_TAKES}"
    return MetricResult(
        "likeness", interval, ceiling.value, note=note, ceiling=ceiling, floors=floors
    )


def likeness_of(clips: Sequence[ClipResult]) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function of weights (B, R) of takes (see `Takes.of`) to likenesses (B,).

    Each group of clips (`groups_of`) is compared with its own recordings; groups are averaged with
    the weights of their takes.
    """
    groups = by_group([clip.pair for clip in clips]).values()

    def measured(weights: np.ndarray) -> np.ndarray:
        total, shares = np.zeros(len(weights)), np.zeros(len(weights))
        for group in groups:
            share = weights @ group.sum(axis=1)
            found = likeness(*_means(clips, weights @ group))
            if found is not None:
                total += np.where(share > 0.0, share * np.nan_to_num(found), 0.0)
                shares += share
        return np.divide(total, shares, out=np.full(len(weights), np.nan), where=shares > 0.0)

    return measured


def likeness_by_group(clips: Sequence[ClipResult]) -> dict[str, float]:
    """Return {group of `groups_of`: likeness} of the groups that can be compared."""
    found = {}
    for name, group in by_group([clip.pair for clip in clips]).items():
        value = likeness(*_means(clips, group.sum(axis=0)[None]))
        if value is not None:
            found[name] = float(value[0])
    return found


def _means(
    clips: Sequence[ClipResult], weights: np.ndarray
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return {measure: (B,) means over clips} of the model and of the recordings.

    Args:
        clips: n clips.
        weights: (B, n) their weights. A measure that a clip with a weight lacks is left out.
    """
    counts = np.asarray(weights.any(axis=0))
    total = np.maximum(weights.sum(axis=1), 1e-12)

    def means(sides: Sequence[Mapping[str, float]]) -> dict[str, np.ndarray]:
        return {
            key: weights @ np.array([side.get(key, 0.0) for side in sides]) / total
            for key in MEASURES
            if all(key in side for side, known in zip(sides, counts) if known)
        }

    return means([clip.metrics for clip in clips]), means([clip.recording for clip in clips])


def defects(metrics: Results) -> list[str]:
    """Return in words what is broken about a motion, whatever else is measured of it."""

    def value(key: str) -> float | None:
        result = metrics.get(key)
        return None if result is None else result.interval.value

    def own(key: str) -> float:
        return (metrics[key].recording if key in metrics else None) or 0.0

    found = []
    beyond, apart, covered = value("joint_limits"), value("one_nn"), value("within_reach")
    more = 0.0 if beyond is None else beyond - own("joint_limits")
    alien = apart is not None and apart >= thresholds.SEPARABLE > own("one_nn")
    empty = covered is not None and covered < thresholds.COVERED * own("within_reach")
    least = thresholds.FAR_BEYOND_LIMITS if alien and empty else thresholds.BEYOND_LIMITS
    if more > least:
        found.append(f"{beyond:.0f} % of joint rotations are beyond the recordings' range")
    shaken = _ratio(metrics, "jerk_genea")
    if shaken is not None and shaken > thresholds.SHAKEN:
        found.append(f"it shakes ({shaken:.0f} times the recordings' jerk)")
    return found


def _timing(clips: Sequence[ClipResult], metrics: Results) -> Finding:
    result = metrics.get("in_time")
    if result is None or result.recording is None:
        return Finding(
            IN_TIME, "in_time", "not measured", "Not measured: no speech with arms to move."
        )
    if not result.informative:
        return _timing_without_recordings(clips, metrics)
    low = result.interval.low
    share = result.interval.value / result.recording
    beyond = low is not None and low <= 0.0 and share < thresholds.IN_TIME
    if share < thresholds.LOOSELY_IN_TIME or beyond or on_its_floor(result):
        return Finding(IN_TIME, "in_time", "no", "Not in time with the speech.")
    if share < thresholds.IN_TIME:
        return Finding(IN_TIME, "in_time", "partly", "Loosely in time with the speech.")
    if share > thresholds.TOO_STRICT:
        text = "In time with the speech, more strictly than the speaker."
        return Finding(IN_TIME, "in_time", "partly", text)
    return Finding(IN_TIME, "in_time", "yes", "As much in time with the speech as the speaker.")


def _timing_without_recordings(clips: Sequence[ClipResult], metrics: Results) -> Finding:
    """Return whether a model is above its own chance level, where recordings give no measure."""
    result = metrics["in_time"]
    if no_room := _no_room(result):
        return _cannot_be_answered(IN_TIME, "in_time", no_room)
    seconds = sum({(c.pair.stem, c.pair.window): c.seconds for c in clips}.values())
    few = (
        f"{seconds:.0f} s of speech are too few, or move the speaker's arms too little, to say "
        "whether as much as the speaker"
    )
    if _above_chance(metrics):
        text = f"In time with the speech more than by chance; {few}."
        return Finding(IN_TIME, "in_time", "partly", text)
    text = f"Not in time with the speech more than by chance; {few}."
    return Finding(IN_TIME, "in_time", UNANSWERABLE, text)


def _above_chance(metrics: Results) -> bool:
    """Return whether a model's own sync is above its chance level."""
    low, sds = metrics["in_time"].interval.low, metrics.get("sync_z")
    if low is not None:
        return low > 0.0
    return sds is not None and sds.interval.value >= thresholds.ABOVE_CHANCE


def _likeness(clips: Sequence[ClipResult], metrics: Results) -> Finding:
    result = metrics.get("likeness")
    if result is None:
        return Finding(LIKE, "likeness", "not measured", "Not measured: no body parts to compare.")
    if not result.informative:
        return _cannot_be_answered(LIKE, "likeness", _no_room(result))
    found = _aspects(clips)
    ceiling = result.ceiling
    usual = {} if ceiling is None else ceiling.aspects
    unusual = [
        aspect
        for aspect, credit in found.items()
        if credit < thresholds.NAMED_ASPECT * usual.get(aspect, 1.0)
    ]
    missed = [
        aspect
        for aspect, credit in found.items()
        if aspect in unusual or (aspect not in TWO_SAMPLE and credit < thresholds.NAMED_ASPECT)
    ]
    missed.sort(key=found.__getitem__)
    differs = f"; what differs: {listed(missed, len(ASPECTS))}" if missed else ""
    differs += _speakers(clips)
    if not result.tested_against_speaker:
        differs += "; not tested against another speaker"
    value, top = result.interval.value, 1.0 if ceiling is None else ceiling.value
    share = value / top if top > 0.0 else 0.0
    known = on_its_floor(result) is None and len(unusual) < thresholds.MANY_ASPECTS
    if known and share >= thresholds.PARTLY_LIKE and value >= thresholds.LEAST_PARTLY_LIKE:
        near = share >= thresholds.LIKE and value >= thresholds.LEAST_LIKE
        if near and not missed:
            return Finding(LIKE, "likeness", "yes", f"Moves like this speaker{differs}.")
        much = "mostly" if near and not unusual else "somewhat"
        return Finding(LIKE, "likeness", "partly", f"Moves {much} like this speaker{differs}.")
    return Finding(LIKE, "likeness", "no", f"Does not move like this speaker{differs}.")


def _aspects(clips: Sequence[ClipResult]) -> dict[str, float]:
    """Return the credit of each aspect, averaged over groups as `likeness_of` does."""
    takes = Takes.of([clip.pair for clip in clips]).count
    found: dict[str, list[tuple[float, float]]] = {}
    for group in by_group([clip.pair for clip in clips]).values():
        weights = group.sum(axis=0)[None] / takes
        for aspect, credit in credits(*_means(clips, weights)).items():
            found.setdefault(aspect, []).append((weights.sum(), float(credit[0])))
    return {
        aspect: sum(share * credit for share, credit in known) / sum(share for share, _ in known)
        for aspect, known in found.items()
    }


def _speakers(clips: Sequence[ClipResult]) -> str:
    """Return the likeness of each speaker in words, if they differ; else ""."""
    found = likeness_by_group(clips)
    if max(found.values()) - min(found.values()) < thresholds.SPEAKERS_DIFFER:
        return ""
    each = [f"{name or 'unnamed'} {value:.2f}" for name, value in found.items()]
    return f"; it differs between speakers: {listed(each, 6)}"


def _novelty(metrics: Results) -> Finding:
    result, low = metrics.get("novelty"), metrics.get("copying_low")
    if result is None:
        text = "Not measured: the clips are too short, or the rig's arms and legs are not known."
        return Finding(NEW, "novelty", "not measured", text)
    among = "training motion" if "training split" in result.note else "the recordings"
    if not result.informative:
        text = (
            f"the recordings themselves are the same as {among}, or do not move. Look for one "
            "recording in two splits."
        )
        return _cannot_be_answered(NEW, "novelty", text)
    now_and_then = low is not None and low.recording and (
        low.interval.value < thresholds.OCCASIONALLY_COPIED * low.recording
    )  # fmt: skip
    if result.interval.value < thresholds.COPIED:
        return Finding(NEW, "novelty", "no", f"Mostly copied from {among}{_seeds(metrics)}.")
    if result.interval.value < thresholds.NEAR:
        text = f"Nearer to {among} than other recordings are: partly copied, or less lively"
        return Finding(NEW, "novelty", "no", f"{text}{_seeds(metrics)}.")
    if now_and_then:
        text = f"New, but occasionally copied from {among}{_seeds(metrics)}."
        return Finding(NEW, "novelty", "partly", text)
    text = f"New: as far from {among} as other recordings"
    if _is_above(result.interval.value, result.ceiling):
        text = f"New: farther from {among} than other recordings, as odd motion is too"
    return Finding(NEW, "novelty", "yes", f"{text}{_seeds(metrics)}.")


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
    """Return a sentence about reach, speed, rests, timing and copying; "" if nothing is known.

    Args:
        metrics: results of a model by key of `definitions`, each with the recording's value.
    """
    still = metrics.get("near_still")
    if still is not None and still.interval.value >= thresholds.MOTIONLESS:
        return "The hands hardly move."
    if broken := defects(metrics):
        return f"The motion is broken: {', '.join(broken)}."
    phrases = [
        *_movement_words(metrics),
        *_rest_words(metrics),
        *_timing_words(metrics),
        *_copying_words(metrics),
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
    reach, fast = _ratio(metrics, "reach"), _ratio(metrics, "hand_q90")
    if reach is not None:
        share = "" if _within(reach, thresholds.ALIKE) else f"{in_words(reach)} "
        yield f"{share}the speaker's reach"
    if fast is not None and not _within(fast, thresholds.ALIKE):
        yield f"fast gestures at {in_words(fast)} the speaker's speed"


def _rest_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    rest, still = metrics.get("rest"), metrics.get("near_still")
    if still is not None and still.interval.value > (still.recording or 0.0) + thresholds.FROZEN:
        yield f"hands frozen in {still.interval.value:.0f} % of the time"
    elif rest is not None and rest.recording and rest.recording >= thresholds.FEW_RESTS:
        ratio = rest.interval.value / rest.recording
        if ratio < thresholds.HARDLY_EVER:
            yield "hardly ever at rest"
        elif ratio < thresholds.RESTS_ALIKE[0]:
            yield "seldom at rest"
        elif ratio > thresholds.RESTS_ALIKE[1]:
            yield "at rest more often than the speaker"
        else:
            yield "at rest as often as the speaker"


def _timing_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    calm, sync = metrics.get("calm_lively_r"), metrics.get("sync")
    if calm is not None and calm.informative and calm.interval.value < thresholds.FOLLOWS:
        yield "calm and lively at other times than the speaker"
    if sync is None or sync.recording is None:
        return
    levels = [level for level in (sync.mismatched, sync.chance) if level is not None]
    chance = max(levels, default=0.0)
    ours, own = sync.interval.value - chance, sync.recording - chance
    if own < thresholds.LEAST_SYNC or not sync.informative:
        if "in_time" in metrics and _above_chance(metrics):
            yield "in time with the speech more than by chance"
    elif ours >= thresholds.IN_TIME * own:
        yield "in time with the speech"
    elif ours >= thresholds.LOOSELY_IN_TIME * own:
        yield "loosely in time with the speech"
    else:
        yield "not in time with the speech"


def _copying_words(metrics: Mapping[str, MetricResult]) -> Iterator[str]:
    median, low = _ratio(metrics, "copying"), _ratio(metrics, "copying_low")
    if median is not None and median < thresholds.COPIED:
        yield "mostly copied from recordings"
    elif (_ratio(metrics, "reach") or 1.0) < thresholds.ALIKE[0]:
        return  # small motion is near to any
    elif median is not None and median < thresholds.NEAR:
        yield "partly copied from recordings"
    elif low is not None and low < thresholds.OCCASIONALLY_COPIED:
        yield "occasionally copied from recordings"


def _ratio(metrics: Mapping[str, MetricResult], key: str) -> float | None:
    """Return a value over the recording's; None without either."""
    result = metrics.get(key)
    if result is None or not result.recording:
        return None
    return result.interval.value / result.recording


def _within(ratio: float, limits: tuple[float, float]) -> bool:
    return limits[0] <= ratio <= limits[1]
