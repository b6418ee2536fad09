"""Table 3 of Alexanderson et al. 2023: merit scores and win rates, from answers of studies.

    python recipes/paper_tables/lda_table3.py TSG=answers/tsg ZeroEGGS=answers/zeroeggs ...

Answers are the CSV files of `gesturekit study` or folders of them. As in the paper, raters who
failed two attention checks are left out; a win rate is that against LDA, ties excluded.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from cells import markdown, number

from gesturekit.evaluation import read_answers
from gesturekit.study import analyse_study
from gesturekit.study.analysis import Preference

CONDITIONS = ("GT", "LDA", "LDA-DW", "LDA-G", "LDA-U", "SG", "ZE", "BL")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("studies", nargs="+", metavar="NAME=ANSWERS")
    parser.add_argument("--rounds", type=int, default=10_000, help="of the bootstrap")
    asked = parser.parse_args(argv)
    names, columns = [], []
    for study in asked.studies:
        name, _, path = study.partition("=")
        result = analyse_study(read_answers([path], failed_checks=2), rounds=asked.rounds)
        names.append(name)
        columns.append({} if result.preference is None else cells(result.preference))
    others = dict.fromkeys(row for column in columns for row in column if row not in CONDITIONS)
    rows = [
        [row, *(cell for column in columns for cell in column.get(row, ("–", "–")))]
        for row in (*CONDITIONS, *others)
    ]
    print(markdown(["", *(f"{n}: {what}" for n in names for what in ("merit", "win rate"))], rows))
    print("–: the condition was not in the study, or never beside LDA.")


def cells(preference: Preference) -> dict[str, tuple[str, str]]:
    """Return merit score and win rate against LDA, %, of each system."""
    wins = {}
    for pair in preference.pairs:
        if "LDA" in (pair.a, pair.b):
            rate = pair.win_rate.value
            other, rate = (pair.a, rate) if pair.b == "LDA" else (pair.b, 1 - rate)
            wins[other] = f"{100 * rate:.1f}"
    return {
        score.name: (
            number(score.merit.value, score.merit.low, score.merit.high),
            wins.get(score.name, "–"),
        )
        for score in preference.systems
    }


if __name__ == "__main__":
    main()
