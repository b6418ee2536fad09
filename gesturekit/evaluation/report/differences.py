"""Differences between the results of two evaluations, in words."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from gesturekit.errors import EvaluationError
from gesturekit.evaluation.report.tables import number
from gesturekit.evaluation.results import FORMAT, Evaluation

_MOST_BYTES = 256 << 20
_SETTINGS = ("fps", "protocol")


def read_results(path: Path) -> dict[str, Any]:
    """Return the values of a results file that `evaluate --json` wrote.

    Raises:
        EvaluationError: it cannot be read, is no such file, or is of a newer format.
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise EvaluationError(f"{path}: too large for results of evaluate")
        values = json.loads(path.read_text(encoding="utf-8"))
        written = values["format"]
        if isinstance(written, int) and written > FORMAT:
            raise EvaluationError(
                f"{path}: format {written} is newer than this gesturekit's ({FORMAT}); update it"
            )
        for model in values["models"]:
            for figure in model["figures"].values():
                float(figure["value"])
            str(model["label"])
    except (OSError, ValueError, RecursionError) as error:
        raise EvaluationError(f"{path}: not a file of evaluate --json: {error}") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise EvaluationError(f"{path}: not a file of evaluate --json ({error})") from error
    return values


def differences(found: Evaluation, before: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences of an evaluation from earlier results, a line each.

    Models are compared by label; where both have only one, these are compared. A change outside the
    earlier interval is marked.

    Args:
        found: the evaluation.
        before: see `read_results`.
    """
    after = found.to_json()
    for name in _SETTINGS:
        if after[name] != before.get(name):
            yield f"{name}: {before.get(name)} before, {after[name]} now: not comparable"
    old = {str(model["label"]): model["figures"] for model in before["models"]}
    new = {model["label"]: model["figures"] for model in after["models"]}
    if len(old) == len(new) == 1:
        old = dict(zip(new, old.values(), strict=True))
    for label in [*new, *(name for name in old if name not in new)]:
        if label not in old or label not in new:
            yield f"{label}: only {'now' if label in new else 'before'}"
            continue
        lines = list(_of_model(old[label], new[label], after["definitions"]))
        yield f"{label}: {f'{len(lines)} of {len(new[label])} values differ' if lines else 'equal'}"
        yield from lines


def _of_model(
    old: Mapping[str, Any], new: Mapping[str, Any], definitions: Mapping[str, Any]
) -> Iterator[str]:
    """Yield a line for each value of a model that differs, is new or is gone."""
    for key in [*new, *(key for key in old if key not in new)]:
        name = definitions[key]["name"] if key in definitions else key
        if key not in old or key not in new:
            yield f"  {name}: only {'now' if key in new else 'before'}"
            continue
        was, now = float(old[key]["value"]), float(new[key]["value"])
        if number(was) == number(now):
            continue
        low, high = old[key].get("low"), old[key].get("high")
        outside = low is not None and high is not None and not low <= now <= high
        unit = f" {new[key]['unit']}" if new[key]["unit"] else ""
        mark = ", outside the earlier interval" if outside else ""
        yield f"  {name}: {number(was)} before, {number(now)}{unit} now{mark}"
