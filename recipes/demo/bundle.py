"""Make the bundled demo model from nothing: corpus, training, card.

    python recipes/demo/bundle.py WORK_DIR [--out gesturekit/models/demo]

Runs `prepare.py`, `gesturekit prepare` and `gesturekit train` in WORK_DIR, then copies the model
and `demo.wav` (as `speech.wav`, with its text) to `--out`. The networks' weights and the recorded
fingers are stored in half precision, and the card (README.md) is the run's own with the figures of
`measure.py`.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from measure import table
from prepare import prepare
from safetensors.torch import load_file, save_file
from texts import DEMO

from audio_features.atomic import atomic_write

HERE = Path(__file__).resolve().parent
BUNDLED = HERE.parents[1] / "gesturekit" / "models" / "demo"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description="Make the bundled demo model from nothing: corpus, training, card."
    )
    parser.add_argument("work", type=Path, metavar="WORK_DIR", help="for the corpus and the run")
    parser.add_argument("--out", type=Path, default=BUNDLED, help="(gesturekit/models/demo)")
    parser.add_argument("--minutes", type=float, default=6.0, help="of paired speech (6)")
    parser.add_argument("--talks", type=int, default=2, help="of each style, for the card (2)")
    parser.add_argument("settings", nargs="*", metavar="KEY=VALUE", help="for the training")
    options = parser.parse_intermixed_args(arguments)
    corpus, run = options.work / "corpus", options.work / "run"
    prepare(corpus, options.minutes, seed=0)
    manifest = corpus / "corpus.jsonl"
    gesturekit(
        *("prepare", corpus / "paired", "--unpaired", corpus / "unpaired", "--out", manifest),
        *("--style-pattern", "(?P<style>calm|lively)_"),
    )
    gesturekit("train", HERE / "config.yaml", f"corpus={manifest}", f"out={run}", *options.settings)
    bundle(run / "model", corpus / "demo.wav", options.out, options.talks)


def gesturekit(*arguments: object) -> None:
    """Run a command of the package, and stop if it fails."""
    command = [sys.executable, "-m", "gesturekit", *map(str, arguments)]
    if code := subprocess.run(command).returncode:
        sys.exit(code)


def bundle(model: Path, speech: Path, out: Path, talks: int) -> None:
    """Copy a model with half the bytes and all that its card says to `out`."""
    out.mkdir(parents=True, exist_ok=True)
    for name in ("config.yaml", "skeleton.json"):
        shutil.copyfile(model / name, out / name)
    shutil.copyfile(speech, out / "speech.wav")
    text = "".join(f"{sentence}\n" for sentence in DEMO).replace("*", "")
    (out / "speech.txt").write_text(text, encoding="utf-8")
    tensors = load_file(model / "model.safetensors")
    halves = ("network.", "recorded.")
    halved = {k: v.half() if k.startswith(halves) else v for k, v in tensors.items()}
    with atomic_write(out / "model.safetensors") as temporary:
        save_file(halved, temporary)
    figures = (
        "## How it moves\n"
        "Talks of 30 s by voices that the corpus lacks; the teacher is the recipe's rule-based\n"
        "talker. Measured by `python recipes/demo/measure.py demo`.\n\n"
        f"{table(str(out), talks)}\n"
    )
    card = (model / "README.md").read_text(encoding="utf-8")
    (out / "README.md").write_text(f"{card}\n{figures}", encoding="utf-8")
    size = sum(path.stat().st_size for path in out.iterdir())
    print(f"{out}: {size / 2**20:.2f} MiB\n\n{figures}")


if __name__ == "__main__":
    main()
