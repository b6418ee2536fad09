"""Measure how often the analysis of a study finds a difference between equal systems.

    python benchmarks/study_false_positives.py [--studies 400] [--seed 0]

Raters and clips differ in which of two equal systems they favour. For each design, the share of
studies with p < .05 is printed for one pair, for any pair after Holm's method, and by Tukey's test,
which takes answers as independent; and the coverage of the 95 % intervals of win rates.
"""

from __future__ import annotations

import argparse
from itertools import combinations

import numpy as np

from gesturekit.evaluation import Answer
from gesturekit.study.analysis.preference import analyse_preference

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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--studies", type=int, default=400, help="of each design (400)")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    rng = np.random.default_rng(options.seed)
    print("systems raters clips  clips' raters' share   pair   any pair   Tukey   coverage")
    for design in DESIGNS:
        pair, holm, tukey, held = [], [], [], []
        for _ in range(options.studies):
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


if __name__ == "__main__":
    main()
