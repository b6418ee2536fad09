"""Training on corpora of several sizes: time and memory, as ratios to the smallest corpus.

"ours" is the smallest corpus of the run, "other" a larger one. For each corpus these commands run
one after the other, each in a process and with a feature cache of its own: the plan of the
training, the arrays of a corpus that is not held in memory, the training, and some renderings of
the bundled speech with the model. Figures:

- wall and user seconds of the training, its arrays and its plan; the estimate in the plan is in
  the note;
- peak resident memory of the training, and peak of its anonymous memory, which leaves out pages of
  memory-mapped files (/proc, so that Linux is needed);
- mean seconds per iteration, from metrics.jsonl;
- size of the model folder, and seconds of the fastest rendering.

The corpora are made from any folder of recordings (`corpus_variants`), by default a made-up one, or
given as manifests. `--make` only makes a corpus:

    python benchmarks/bench_corpus_size.py --make recordings --hours 2 --out corpora/2h
    python benchmarks/bench_corpus_size.py --corpora corpora/1min/corpus.jsonl \\
        corpora/2h/corpus.jsonl
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

from corpus_variants import make_corpus
from harness import common_options, report, with_children

from gesturekit.corpus import Manifest
from gesturekit.systems import bundled_speech

HOURS, QUICK_HOURS = (0.02, 0.4), (0.003, 0.012)
QUICK_SETTINGS = (
    "training.first_stage=4",
    "training.further_stages=2",
    "training.window=2",
)
RENDERINGS, QUICK_RENDERINGS = 3, 1
PACE = "seconds_per_iteration"
SAMPLE_EVERY = 0.05
"""Seconds between two readings of the memory of a process."""


@dataclass(frozen=True)
class Usage:
    """Cost of a process and those that it started: seconds, and memory in MiB."""

    wall: float
    user: float
    resident: float
    anonymous: float


def program(*arguments: str | Path) -> list[str]:
    """Return a command line of gesturekit."""
    return [sys.executable, "-m", "gesturekit", *map(str, arguments)]


def measured(command: Sequence[str], folder: Path, name: str) -> Usage:
    """Run a command with an empty feature cache; its output goes to NAME.log in the folder."""
    log = folder / f"{name}.log"
    environment = {**os.environ, "GESTUREKIT_CACHE": str(folder / f"{name}_cache")}
    resident, anonymous, ended = 0, 0, 0
    start = time.perf_counter()
    with log.open("w", encoding="utf-8") as out:
        process = subprocess.Popen(command, env=environment, stdout=out, stderr=subprocess.STDOUT)
        while not ended:
            memory = [_memory(pid) for pid in with_children(process.pid)]
            resident = max(resident, sum(one for one, _ in memory))
            anonymous = max(anonymous, sum(one for _, one in memory))
            time.sleep(SAMPLE_EVERY)
            ended, status, used = os.wait4(process.pid, os.WNOHANG)
    wall = time.perf_counter() - start
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise SystemExit(f"{' '.join(command)}:\n{log.read_text(encoding='utf-8')[-3000:]}")
    return Usage(wall, used.ru_utime, resident / 1024, anonymous / 1024)


def _memory(pid: int) -> tuple[int, int]:
    """Return peak resident and present anonymous memory of a process, KiB; 0 if it has ended."""
    try:
        status = Path(f"/proc/{pid}/status").read_text()
    except OSError:
        return 0, 0
    values = dict(re.findall(r"^(VmHWM|RssAnon):\s*(\d+)", status, re.MULTILINE))
    return int(values.get("VmHWM", 0)), int(values.get("RssAnon", 0))


def costs(
    manifest: Path,
    recipe: str,
    settings: Sequence[str],
    renderings_per_model: int,
    folder: Path,
) -> dict[str, float]:
    """Train on a corpus and render with the model; return the figures by name."""
    folder.mkdir()
    run = folder / "run"
    training = ("train", recipe, f"corpus={manifest}", f"out={run}", *settings)
    # In this order: the training finds the arrays that the command before it made.
    training = (*training, f"arrays={folder / 'arrays'}")
    commands = {
        "plan": program(*training, "--plan"),
        "arrays": program(*training, "--arrays"),
        "train": program(*training),
    }
    used = {name: measured(command, folder, name) for name, command in commands.items()}
    renderings = []
    for i in range(renderings_per_model):
        options = ("--model", run / "model", "--out", folder / f"rendered{i}")
        command = program("render", bundled_speech(), *options)
        renderings.append(measured(command, folder, f"render{i}").wall)
    figures = {"estimate": estimate((folder / "plan.log").read_text(encoding="utf-8"))}
    for name, usage in used.items():
        figures |= {f"{name}_wall": usage.wall, f"{name}_user": usage.user}
        figures |= {f"{name}_resident": usage.resident, f"{name}_anonymous": usage.anonymous}
    return figures | {
        "iteration": seconds_per_iteration(run / "metrics.jsonl"),
        "model": sum(f.stat().st_size for f in (run / "model").rglob("*") if f.is_file()) / 2**20,
        "render": min(renderings),
    }


def estimate(log: str) -> float:
    """Return the seconds that `train --plan` says the training takes."""
    number, unit = re.search(r"Time: about ([\d.]+) (s|min|h) ", log).groups()
    return float(number) * {"s": 1, "min": 60, "h": 3600}[unit]


def seconds_per_iteration(metrics: Path) -> float:
    """Return the mean over all iterations."""
    lines = map(json.loads, metrics.read_text(encoding="utf-8").splitlines())
    paces = {line["step"]: line["seconds_per_iteration"] for line in lines if PACE in line}
    steps = [later - earlier for earlier, later in pairwise([0, *paces])]
    return statistics.fmean(paces.values(), weights=steps)


def corpus_hours(manifest: Path) -> float:
    return sum(item.duration for item in Manifest.load(manifest) if item.is_paired) / 3600


def size(hours: float) -> str:
    """Return a length for the name of a figure: "23min" or "2h"."""
    return f"{60 * hours:.2g}min" if hours < 1 else f"{hours:.2g}h"


def compared(table: dict[float, dict[str, float]]) -> dict[str, dict[str, float | str]]:
    """Return the rows of the report; `table` has the figures of each size in hours."""
    smallest, *others = sorted(table)
    rows = {}
    for hours in others:
        for name, value in table[hours].items():
            if name == "estimate":
                continue
            base = table[smallest][name]
            note = f"ours: {size(smallest)}; other: {size(hours)}"
            if name == "plan_wall":
                estimates = [f"{table[h]['estimate']:.0f} s" for h in (smallest, hours)]
                note += f"; estimated trainings: {' and '.join(estimates)}"
            row = {"ours": base, "other": value, "ratio": value / base, "note": note}
            is_memory = name == "model" or name.endswith(("resident", "anonymous"))
            rows[f"{name}_{size(hours)}"] = row | ({"unit": "MiB"} if is_memory else {})
    return rows


def made_up_recordings(folder: Path) -> Path:
    """Return a folder of one recording: the bundled speech with motion of the demo model."""
    folder.mkdir()
    speech = bundled_speech()
    shutil.copy(speech, folder)
    options = ("--model", "demo", "--out", folder, "--format", "bvh")
    subprocess.run(program("render", speech, *options), check=True, capture_output=True)
    return folder


def options() -> argparse.Namespace:
    parser = common_options(__doc__.splitlines()[0])
    add = parser.add_argument
    add("--make", type=Path, metavar="FOLDER", help="only make a corpus of these recordings")
    add("--out", type=Path, help="folder of the corpus that --make makes")
    add("--recordings", type=Path, help="folder of wav and BVH files; default: made-up ones")
    add("--hours", type=float, nargs="+", help="lengths of the corpora to make")
    add("--format", choices=("bvh", "npz"), default="bvh", help="of the motion that is made")
    add("--speakers", type=int, default=0, help="speakers whose names the takes get in turn")
    add("--seed", type=int, default=0, help="of the corpora that are made")
    add("--corpora", type=Path, nargs="+", help="manifests to train on instead of making any")
    add("--recipe", default="own_corpus", help="recipe that renders from speech alone")
    add("--set", nargs="+", default=[], metavar="KEY=VALUE", help="settings of the training")
    chosen = parser.parse_args()
    if chosen.make and not (chosen.out and chosen.hours and len(chosen.hours) == 1):
        parser.error("--make needs --out and one length in --hours")
    return chosen


def main() -> None:
    chosen = options()
    made = {"suffix": chosen.format, "speakers": chosen.speakers, "seed": chosen.seed}
    if chosen.make:
        print(make_corpus(chosen.make, chosen.hours[0], chosen.out, **made))
        return
    settings = [*(QUICK_SETTINGS if chosen.quick else ()), *chosen.set]
    renderings = QUICK_RENDERINGS if chosen.quick else RENDERINGS
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        manifests = chosen.corpora
        if not manifests:
            recordings = chosen.recordings or made_up_recordings(folder / "recordings")
            lengths = chosen.hours or (QUICK_HOURS if chosen.quick else HOURS)
            manifests = [
                make_corpus(recordings, hours, folder / f"corpus{i}", **made)
                for i, hours in enumerate(lengths)
            ]
        table = {}
        for i, manifest in enumerate(manifests):
            run = folder / f"training{i}"
            table[corpus_hours(manifest)] = costs(
                manifest, chosen.recipe, settings, renderings, run
            )
    report(compared(table), chosen.json)


if __name__ == "__main__":
    main()
