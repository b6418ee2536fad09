"""Measure how often the analysis of a study finds a difference between equal systems, and between
systems that differ.

    python benchmarks/study_false_positives.py [--studies 400] [--seed 0] [--power]

Raters and clips differ in which of two equal systems they favour. For each design, the share of
studies with p < .05 is printed for one pair, for any pair after Holm's method, and by Tukey's test,
which takes answers as independent; and the coverage of the 95 % intervals of win rates.

With --power, one of two systems is better: the share of studies that find it is printed beside the
power of `gesturekit study power`, for the number of raters that it gives for a power of .8.
"""

from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np
from scipy.stats import norm

from gesturekit.evaluation import Answer
from gesturekit.study import raters_needed
from gesturekit.study.analysis import Votes, analyse_preference, compare
from gesturekit.study.power import Expected, power_of

DESIGNS = (  # systems, raters, clips, share of clips and of raters in the variance of answers
    (2, 50, 12, 0.0, 0.0),
    (2, 50, 12, 0.17, 0.19),
    (2, 100, 36, 0.17, 0.0),
    (2, 100, 36, 0.1, 0.1),
    (3, 50, 12, 0.17, 0.05),
    (3, 50, 36, 0.0, 0.19),
    (3, 100, 36, 0.17, 0.19),
    (3, 100, 12, 0.0, 0.0),
)
ANSWERS = 12  # of each rater
SLIGHT, CLEAR = 0.3, 1.0  # least size of such a preference, standard deviations
POWER = (  # expected answers, answers of a rater, clips
    (Expected(0.6, 0.2, 0.4, 0.05, 0.1), 12, 60),
    (Expected(0.65, 0.2, 0.4, 0.05, 0.17), 6, 36),
    (Expected(0.65, 0.1, 0.6, 0.19, 0.0), 12, 24),
    (Expected(0.7, 0.3, 0.3, 0.0, 0.1), 3, 24),
)


def study(
    rng: np.random.Generator,
    systems: int,
    raters: int,
    clips: int,
    of_clips: float,
    of_raters: float,
) -> list[Answer]:
    """Draw the answers of a study of equal systems; pairs of systems take turns."""
    pairs = list(combinations("abc"[:systems], 2))
    rater, clip = (
        rng.standard_normal((raters, len(pairs))),
        rng.standard_normal((clips, len(pairs))),
    )
    found = []
    for r in range(raters):
        for n, c in enumerate(rng.permutation(clips)[:ANSWERS]):
            pair = (n + r) % len(pairs)
            value = np.sqrt(of_raters) * rater[r, pair] + np.sqrt(of_clips) * clip[c, pair]
            value += np.sqrt(1.0 - of_raters - of_clips) * rng.standard_normal()
            size = int(np.digitize(abs(value), (SLIGHT, CLEAR)))
            found.append(Answer(f"r{r}", f"c{c}", *pairs[pair], int(np.sign(value)) * size))
    return found


def different(
    rng: np.random.Generator, expected: Expected, raters: int, answers: int, clips: int
) -> list[Answer]:
    """Draw answers of a study in which "a" is better: normal preferences, cut at thresholds."""
    mean, slight, clear = expected.thresholds()
    # Shares are those of scores, which are cut; of what is cut they are larger.
    value = mean + norm.isf((np.arange(10_000) + 0.5) / 10_000)
    kept = np.corrcoef(value, np.sign(value) * np.digitize(abs(value), (slight, clear)))[0, 1] ** 2
    of_raters, of_clips = expected.rater_share / kept, expected.clip_share / kept
    rater, clip = rng.standard_normal(raters), rng.standard_normal(clips)
    found = []
    for r in range(raters):
        for c in rng.permutation(clips)[:answers]:
            preference = mean + np.sqrt(of_raters) * rater[r] + np.sqrt(of_clips) * clip[c]
            preference += np.sqrt(1 - of_raters - of_clips) * rng.standard_normal()
            size = int(np.digitize(abs(preference), (slight, clear)))
            found.append(Answer(f"r{r}", f"c{c}", "a", "b", int(np.sign(preference)) * size))
    return found


def print_power(rng: np.random.Generator, studies: int) -> None:
    print("win rate  ties  clear  raters' clips' share  answers  clips  raters  power  simulated")
    for expected, answers, clips in POWER:
        raters = raters_needed(expected, answers, clips)
        assert raters is not None
        found = [
            compare(Votes.of(different(rng, expected, raters, answers, clips)))[0].p < 0.05
            for _ in range(studies)
        ]
        power = power_of(expected, raters, answers, clips)
        print(
            f"{expected.win_rate:>8}  {expected.ties:>4}  {expected.clear:>5}"
            f"  {expected.rater_share:>7} {expected.clip_share:>12}  {answers:>7}  {clips:>5}"
            f"  {raters:>6}  {power:>5.3f}  {np.mean(found):>9.3f}",
            flush=True,
        )


def print_false_positives(rng: np.random.Generator, studies: int) -> None:
    print("systems raters clips  clips' raters' share   pair   any pair   Tukey   coverage")
    for design in DESIGNS:
        pair, holm, tukey, held = [], [], [], []
        for _ in range(studies):
            pairs = analyse_preference(study(rng, *design), rounds=1, seed=0).pairs
            pair += [each.p < 0.05 for each in pairs]
            holm.append(min(each.p_holm for each in pairs) < 0.05)
            tukey.append(min(each.p_tukey for each in pairs) < 0.05)
            held += [each.win_rate.low <= 0.5 <= each.win_rate.high for each in pairs]
        systems, raters, clips, of_clips, of_raters = design
        print(
            f"{systems:>7} {raters:>6} {clips:>5} {of_clips:>7} {of_raters:>7}         "
            + "   ".join(f"{np.mean(values):>5.3f}" for values in (pair, holm, tukey, held)),
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=" ".join(__doc__.split("\n\n")[0].split()))
    parser.add_argument("--studies", type=int, default=400, help="of each design (400)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--power", action="store_true", help="systems that differ instead")
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    (print_power if options.power else print_false_positives)(rng, options.studies)


if __name__ == "__main__":
    main()
