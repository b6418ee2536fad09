"""Simulate corpora with known truth: coverage of 95 % intervals, and false differences.

    python benchmarks/interval_coverage.py --corpora 2000

Takes are nested in 1, 2 or 3 speakers, in unequal shares; each take has 1 to 12 clips. A clip's
value is the inverse link of (level + speaker + take + clip), all three normal: speeds are
log-normal, correlations have Fisher's z, shares the logit. The truth is the mean over new takes of
the same speakers. Two models of equal truth share half of the variance of takes and of clips, since
they answer the same speech; the rest is their own.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from scipy.special import expit

from gesturekit.evaluation.definitions import DEFINITIONS
from gesturekit.evaluation.statistics.intervals import Takes, interval_of
from gesturekit.evaluation.statistics.paired import p_of_difference

SIZES = (6, 12, 24)
"""Numbers of takes."""
SHARES = {1: (1.0,), 2: (2 / 3, 1 / 3), 3: (1 / 2, 1 / 3, 1 / 6)}
"""Shares of the takes that each speaker has, by number of speakers."""
MOST_CLIPS = 12
SHARED = 0.5
"""Share of the variance of takes and of clips that two models have in common."""
SPEAKERS = 0.5
"""Standard deviation between speakers over that between clips of a take."""
DIFFERS = 0.05


@dataclass(frozen=True)
class Truth:
    """Distribution of a metric over clips, on the scale of the link.

    Attributes:
        key: key of `definitions`.
        level: mean.
        takes: standard deviation between takes.
        clips: standard deviation between the clips of a take.
        inverse: inverse of the link, to the unit of the metric.
    """

    key: str
    level: float
    takes: float
    clips: float
    inverse: Callable[[np.ndarray], np.ndarray]

    def expected(self, offset: np.ndarray) -> np.ndarray:
        """Return the expected values at offsets from the level, by Gauss-Hermite quadrature."""
        nodes, weights = np.polynomial.hermite_e.hermegauss(80)
        spread = np.hypot(self.takes, self.clips) * nodes
        return self.inverse(self.level + offset[:, None] + spread) @ weights / weights.sum()


def percentage(link: np.ndarray) -> np.ndarray:
    return 100.0 * expit(link)


TRUTHS = (
    Truth("hand_q50", -1.8, 0.45, 0.97, np.exp),
    Truth("hand_q90", -0.3, 0.30, 0.44, np.exp),
    Truth("reach", -2.2, 0.46, 0.31, np.exp),
    Truth("sync", 0.55, 0.14, 0.40, np.tanh),
    Truth("bc", 0.35, 0.15, 0.37, expit),
    Truth("rest", -0.7, 0.46, 1.04, percentage),
    Truth("near_still", -2.9, 1.02, 1.83, percentage),
    Truth("within_reach", 3.0, 0.46, 1.04, percentage),
)
"""Measured once on 39 clips of 10 s: three takes of a ZeroEGGS speaker (31 clips), whose take means
have the standard deviations .45 (median hand speed), .27 (its 90 % quantile), .46 (reach), .46 and
1.02 (shares of rest and of near stillness) beyond that of their clips, which is the second number;
sync and beat consistency differ between takes by .13 and .08 there and by .14 and .22 over eight
takes of four SHOW speakers. `within_reach` stands for shares near 100 %, with the spreads of rest.
They were written down before any interval was computed."""


def corpora(
    truth: Truth, takes: int, speakers: int, number: int, rng: np.random.Generator
) -> Iterator[tuple[Takes, np.ndarray, np.ndarray, float]]:
    """Yield nesting, values of two models of equal truth (n,), and the truth, of each corpus."""
    counts = np.maximum(1, np.round(takes * np.array(SHARES[speakers]))).astype(int)
    speaker = np.repeat(np.arange(speakers), counts)
    for _ in range(number):
        offset = rng.normal(0.0, SPEAKERS * truth.clips, speakers)
        clips = rng.integers(1, MOST_CLIPS + 1, takes)
        take = np.repeat(np.arange(takes), clips)
        common, *own = (
            np.sqrt(share)
            * (rng.normal(0.0, truth.takes, takes)[take] + rng.normal(0.0, truth.clips, len(take)))
            for share in (SHARED, 1.0 - SHARED, 1.0 - SHARED)
        )
        level = truth.level + offset[speaker][take] + common
        nested = Takes.nested([f"{t:02d}" for t in take], [str(s) for s in speaker[take]])
        one, other = (truth.inverse(level + values) for values in own)
        yield nested, one, other, float(truth.expected(offset)[speaker].mean())


def rates(truth: Truth, takes: int, speakers: int, number: int, seed: int = 0) -> dict[str, float]:
    """Return the shares of corpora whose interval holds the truth, misses it below and above, lies
    outside the metric's range or is missing, and in which equal models differ."""
    low, high = within = DEFINITIONS[truth.key].within
    rng = np.random.default_rng((seed, takes, speakers, *truth.key.encode()))
    found = []
    for nested, one, other, expected in corpora(truth, takes, speakers, number, rng):
        interval = interval_of(one, nested, within)
        p = p_of_difference(nested.means(one), nested.means(other), nested.speakers)
        none = interval.low is None or p is None
        found.append(
            (True, False, False, False, False, False)
            if none
            else (
                False,
                interval.low <= expected <= interval.high,
                expected < interval.low,
                expected > interval.high,
                not low <= interval.low <= interval.value <= interval.high <= high,
                p < DIFFERS,
            )
        )
    names = ("none", "covered", "too_high", "too_low", "outside", "differs")
    return dict(zip(names, np.mean(found, axis=0).tolist(), strict=True))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--corpora", type=int, default=2000, help="of each kind and size")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    start = time.perf_counter()
    print(
        "| metric | speakers | takes | covered | above the truth | below | out of range | differs |"
    )
    print("|---|---|---|---|---|---|---|---|")
    every = []
    for truth in TRUTHS:
        for speakers in SHARES:
            for takes in SIZES:
                one = rates(truth, takes, speakers, asked.corpora, asked.seed)
                every.append((takes, one))
                print(
                    f"| {truth.key} | {speakers} | {takes} | {100 * one['covered']:.1f} % "
                    f"| {100 * one['too_high']:.1f} % | {100 * one['too_low']:.1f} % "
                    f"| {100 * one['outside']:.1f} % | {100 * one['differs']:.1f} % |",
                    flush=True,
                )
    for takes in SIZES:
        cells = [one for size, one in every if size == takes]
        covered, differs = ([100 * one[k] for one in cells] for k in ("covered", "differs"))
        print(
            f"{takes} takes: covered {np.mean(covered):.1f} % ({min(covered):.1f} to "
            f"{max(covered):.1f}), differs {np.mean(differs):.1f} % ({min(differs):.1f} to "
            f"{max(differs):.1f})"
        )
    print(f"{asked.corpora} corpora of each kind in {time.perf_counter() - start:.0f} s")


if __name__ == "__main__":
    main()
