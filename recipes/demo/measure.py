"""Measure how a model trained on the demo corpus moves, beside its teacher.

    python recipes/demo/measure.py MODEL [--talks 2] [--seed 2000]

Makes talks of 30 s, calm and lively, by voices that are in no part of the corpus; the model and
the rule-based talker gesture to each. The table is what the model's card states. `measure.py
teacher` measures the talker alone.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from itertools import combinations

import numpy as np
from prepare import ITEM_SECONDS, STYLES, monologue, shuffled
from talker import talk
from texts import ENGLISH

import gesturekit as gk
from audio_features import Wave
from gesturekit.evaluation import hand_movement, jerk, sync
from gesturekit.evaluation.metrics.physical import joint_speed
from gesturekit.motion.parts import find_parts
from gesturekit.motion.rotations import IDENTITY, rotation_angles

VOICES = ("en-us+m5", "en+f3", "en-gb-x-rp+m6", "en-us+f5")
"""Voices that `prepare.py` never uses."""
SEEDS = (0, 1)
_WRISTS = ("LeftHand", "RightHand")

Gesturer = Callable[[Wave, int], gk.Motion]
"""A speech and a seed to a motion: a model, or the talker."""


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", help="a model folder, a bundled name, or `teacher`")
    parser.add_argument("--talks", type=int, default=2, help="of each style (2)")
    parser.add_argument("--seed", type=int, default=2000, help="of the talks (2000)")
    options = parser.parse_args(arguments)
    print(table(options.model, options.talks, options.seed))


def table(model: str, talks: int = 2, seed: int = 2000) -> str:
    """The figures as a Markdown table: a row a style for the model, and for the talker."""
    gesturers: dict[str, Gesturer] = {"teacher": talk}
    if model != "teacher":
        loaded = gk.load(model)
        gesturers = {
            "model": lambda wave, seed: loaded.generate(wave, seed=seed),
            **gesturers,
        }
    lines = [
        "| talks | wrist speed, m/s: median, fastest tenth | hands at rest, % "
        "| hand height range, m | reach, m | jerk, m/s³ | finger range, ° "
        "| two seeds apart, m | sync r (by chance) |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    speech = {style: held_out_talks(style, talks, seed) for style in STYLES}
    for name, gesturer in gesturers.items():
        for style, waves in speech.items():
            found = np.mean([figures(gesturer, wave) for wave in waves], axis=0)
            median, fast, rest, height, reach, shaking, bent, apart, r, chance = found
            lines.append(
                f"| {style}, {name} | {median:.2f}, {fast:.2f} | {100 * rest:.0f} | {height:.2f} "
                f"| {reach:.2f} | {shaking:.0f} | {bent:.0f} | {apart:.2f} "
                f"| {r:.2f} ({chance:.2f}) |"
            )
    return "\n".join(lines)


def held_out_talks(style: str, talks: int, seed: int) -> list[Wave]:
    """Talks of `ITEM_SECONDS` by voices that the corpus does not have."""
    result = []
    for k in range(talks):
        rng = np.random.default_rng([seed, k, *style.encode()])
        texts = shuffled(ENGLISH, rng)
        samples, rate = monologue(texts, VOICES[k % len(VOICES)], STYLES[style], ITEM_SECONDS, rng)
        result.append(Wave(samples.astype(np.float32), rate))
    return result


def figures(gesturer: Gesturer, wave: Wave) -> np.ndarray:
    """Measure the motions of one speech, means over `SEEDS`.

    Returns:
        (10,): median of the wrists' speed and its 90 % quantile (m/s, over frames and wrists);
        share of rest (`HandMovement.rest`); range of the hands' height (m); reach (m,
        `HandMovement.reach`); jerk of the body joints (m/s^3); range of the fingers'
        joints (`finger_range`); distance of the hands between two seeds (m, mean over frames);
        sync, and its chance level.
    """
    motions = [gesturer(wave, seed) for seed in SEEDS]
    rows = []
    for motion in motions:
        speed, moved = joint_speed(motion, _WRISTS), hand_movement(motion)
        quantiles = np.quantile(speed, (0.5, 0.9))
        height = np.ptp(hands(motion)[..., 1])
        shaking, bent = jerk(motion), finger_range(motion)
        rows.append([*quantiles, moved.rest, height, moved.reach, shaking, bent])
    apart = [
        np.linalg.norm(hands(one) - hands(other), axis=-1).mean()
        for one, other in combinations(motions, 2)
    ]
    found = [sync(motion, wave) for motion in motions]
    synced = np.mean([[each.r, each.chance_mean] for each in found], axis=0)
    return np.array([*np.mean(rows, axis=0), np.mean(apart), *synced])


def finger_range(motion: gk.Motion) -> float:
    """Degrees from the 5 % to the 95 % quantile of a finger joint's angle, mean over the joints."""
    joints = [motion.skeleton.index(name) for name in find_parts(motion.skeleton).fingers]
    if not joints:
        return 0.0
    low, high = np.quantile(
        rotation_angles(motion.rotations[:, joints], IDENTITY), (0.05, 0.95), axis=0
    )
    return float(np.degrees(high - low).mean())


def hands(motion: gk.Motion) -> np.ndarray:
    """Positions of both wrists in the world, (T, 2, 3) m."""
    return motion.positions()[:, [motion.skeleton.index(name) for name in _WRISTS]]


if __name__ == "__main__":
    main()
