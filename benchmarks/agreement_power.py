"""Simulate user studies with known truth: how often a metric is ranked as it is.

    python benchmarks/agreement_power.py --studies 1000

Systems have a quality that people rate on sliders of 0 to 100. Of four metrics, one is right (it
orders all systems as their quality does), one is half right (correlation .8 with quality, tau .59),
one is blind (independent of quality) and one inverted. A metric has one value a take, with noise of
`METRIC_NOISE`, half of which systems share, since they answer the same speech.

Each rater rates `PAGES` clips, and on each page all systems. A rating is quality + rater + clip +
system in this clip + residual, rounded to a slider's steps and clipped to its range. Spreads are
chosen to fit GENEA 2022, where medians of systems were 28 to 71 and 95 % intervals of means about
1.4 to either side with some 950 ratings a system: a standard deviation of 22 (figures remembered
from its table of human-likeness; not checked again).
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from gesturekit.evaluation.results import MetricAgreement
from gesturekit.evaluation.statistics.agreement import agreement_of, chance_range
from gesturekit.evaluation.statistics.answers import Ratings
from gesturekit.evaluation.statistics.scores import RESAMPLES, scores_of

LEVEL, SYSTEMS, RATERS, CLIPS, INTERACTION, RESIDUAL = 45.0, 14.0, 12.0, 6.0, 7.0, 16.0
"""Mean, and standard deviations: between systems, between raters, between clips, of a system in a
clip, and of the residual. The last four make 22 together."""
PAGES = 10
TAKES = 10
METRIC_NOISE = 0.3
"""Standard deviation of a metric between takes over that between systems."""
CORRELATIONS = {"right": 1.0, "half right": 0.8, "blind": 0.0, "inverted": -1.0}


@dataclass(frozen=True)
class Design:
    """Size of a study.

    Attributes:
        systems, clips, raters: their numbers.
        missing: share of the ratings that are missing; each system also lacks that share of clips.
    """

    systems: int
    clips: int
    raters: int
    missing: float = 0.0

    @property
    def ratings(self) -> int:
        """Expected number of ratings."""
        kept = (1.0 - self.missing) ** 2
        return round(self.systems * self.raters * min(PAGES, self.clips) * kept)


DESIGNS = (
    Design(9, 40, 20),
    Design(9, 40, 50),
    Design(9, 40, 50, 0.2),
    Design(9, 40, 200),
    Design(6, 40, 50),
    Design(14, 40, 50),
)


def study(design: Design, quality: np.ndarray, rng: np.random.Generator) -> Ratings:
    """Return a study of systems with a known quality."""
    raters, clips, systems = design.raters, design.clips, design.systems
    seen = [rng.choice(clips, min(PAGES, clips), replace=False) for _ in range(raters)]
    rater = np.repeat(np.arange(raters), len(seen[0]) * systems)
    clip = np.repeat(np.concatenate(seen), systems)
    system = np.tile(np.arange(systems), raters * len(seen[0]))
    there = rng.random(len(system)) >= design.missing
    there &= (rng.random((systems, clips)) >= design.missing)[system, clip]
    rater, clip, system = rater[there], clip[there], system[there]
    value = (
        LEVEL
        + quality[system]
        + rng.normal(0.0, RATERS, raters)[rater]
        + rng.normal(0.0, CLIPS, clips)[clip]
        + rng.normal(0.0, INTERACTION, (systems, clips))[system, clip]
        + rng.normal(0.0, RESIDUAL, len(system))
    )
    names = (tuple(map(str, range(n))) for n in (systems, raters, clips))
    question = np.zeros(len(system), int)
    return Ratings(*names, ("",), system, rater, clip, question, value.round().clip(0, 100))


def metric(quality: np.ndarray, correlation: float, rng: np.random.Generator) -> np.ndarray:
    """Return (1 + B, S) values of a metric: over all takes, and over takes drawn again."""
    own = rng.normal(0.0, 1.0, len(quality))
    truth = correlation * quality / SYSTEMS + np.sqrt(1.0 - correlation**2) * own
    noise = rng.normal(0.0, METRIC_NOISE, (TAKES, len(quality) + 1)) * np.sqrt(0.5)
    takes = truth + noise[:, 1:] + noise[:, :1]
    drawn = rng.multinomial(TAKES, np.full(TAKES, 1.0 / TAKES), RESAMPLES)
    return np.vstack([np.ones(TAKES), drawn]) @ takes / TAKES


def studies(design: Design, number: int, seed: int) -> Iterator[dict[str, MetricAgreement]]:
    """Yield {metric: agreement} of each study."""
    rng = np.random.default_rng((seed, design.systems, design.raters, int(100 * design.missing)))
    for _ in range(number):
        quality = rng.normal(0.0, SYSTEMS, design.systems)
        ratings = study(design, quality, rng)
        scores = scores_of(ratings, np.ones(len(ratings.value), bool), ratings.systems, seed)
        found = {}
        for name, correlation in CORRELATIONS.items():
            value, *drawn = metric(quality, correlation, rng)
            kept = np.arange(design.systems)
            found[name] = agreement_of(name, value, np.array(drawn), scores, kept, seed)
        yield found


def rates(name: str, found: list[MetricAgreement], systems: int) -> dict[str, float]:
    """Return how a metric came out: means of its figures, and shares of studies."""
    chance, truth = chance_range(systems), 2.0 / np.pi * np.arcsin(CORRELATIONS[name])
    accuracy = [one.accuracy for one in found if one.accuracy is not None]
    return {
        "tau": float(np.mean([one.kendall for one in found])),
        "true tau": float(truth),
        "above chance": float(np.mean([one.kendall > chance for one in found])),
        "below chance": float(np.mean([one.kendall < -chance for one in found])),
        "covered": float(np.mean([one.low <= truth + 1e-9 and truth - 1e-9 <= one.high
                                  for one in found])),
        "width": float(np.mean([one.high - one.low for one in found])),
        "accuracy": float(np.mean(accuracy)),
        "pairs": float(np.mean([one.pairs for one in found])),
    }  # fmt: skip


def false_alarms(design: Design, number: int, seed: int) -> float:
    """Return the share of studies of equal systems in which any pair differs significantly."""
    rng, found = np.random.default_rng((seed, 1, design.raters)), []
    for _ in range(number):
        ratings = study(design, np.zeros(design.systems), rng)
        kept = np.ones(len(ratings.value), bool)
        found.append(scores_of(ratings, kept, ratings.systems, seed).differ.any())
    return float(np.mean(found))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--quick", action="store_true", help="under 60 s on 2 cores")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--studies", type=int, default=500, help="of each size")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    number = 20 if asked.quick else asked.studies
    start, figures = time.perf_counter(), {}
    print(
        "| systems | raters | ratings | metric | true tau | mean tau | above chance | below chance "
        "| interval covers | width | pairwise accuracy | significant pairs |"
    )
    print("|---" * 12 + "|")
    for design in DESIGNS:
        found = list(studies(design, number, asked.seed))
        for name in CORRELATIONS:
            one = rates(name, [each[name] for each in found], design.systems)
            figures[f"{design.systems} systems, {design.ratings} ratings, {name}"] = one
            print(
                f"| {design.systems} | {design.raters} | {design.ratings:,} | {name} "
                f"| {one['true tau']:+.2f} | {one['tau']:+.2f} | {one['above chance']:.1%} "
                f"| {one['below chance']:.1%} | {one['covered']:.1%} | {one['width']:.2f} "
                f"| {one['accuracy']:.1%} | {one['pairs']:.1f} |",
                flush=True,
            )
        in_order = np.mean([
            each["right"].kendall > each["blind"].kendall > each["inverted"].kendall
            for each in found
        ])  # fmt: skip
        alarms = false_alarms(design, number, asked.seed)
        size = f"{design.systems} systems, {design.ratings} ratings"
        figures[size] = {"in order": float(in_order), "false alarms": alarms}
        print(
            f"right above blind above inverted in {in_order:.1%} of studies; with equal systems, "
            f"any pair is significant in {alarms:.1%}"
        )
    print(f"{number} studies of each size in {time.perf_counter() - start:.0f} s")
    if asked.json is not None:
        asked.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
