"""Table 2 of Alexanderson et al. 2023: the designs of the user studies, from their configurations.

    python recipes/paper_tables/lda_table2.py [DESIGN.yaml ...]

`gesturekit study build designs/tsg.yaml` makes the page of a study.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from cells import markdown

from gesturekit.study.config import load_study_config

DESIGNS = Path(__file__).parent / "designs"


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("designs", nargs="*", type=Path, help="configurations; by default all here")
    paths = parser.parse_args(argv).designs or sorted(DESIGNS.glob("*.yaml"))
    studies = [load_study_config(path) for path in paths]
    conditions = [len(study.systems) for study in studies]
    ordered = [n * (n - 1) for n in conditions]
    asked = [study.pairs or 0 for study in studies]
    rows: dict[str, list[object]] = {
        "design": [study.design for study in studies],
        "conditions": list(conditions),
        "ordered pairs": list(ordered),
        "styles of the question": [*(len(study.styles) for study in studies)],
        "comparisons of a rater": list(asked),
        "ordered pairs seen": [f"{n / k:g}" for n, k in zip(asked, ordered, strict=True)],
        "sound": ["no" if study.design == "style" else study.sound for study in studies],
    }
    head = ["", *(path.stem for path in paths)]
    print(markdown(head, [[name, *map(str, values)] for name, values in rows.items()]))


if __name__ == "__main__":
    main()
