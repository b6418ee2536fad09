"""Run the evaluation of one of the two papers, and write its table with ours beside it.

    python tables.py multires runs/labels/model corpus.jsonl
    python tables.py lda runs/speech/model recordings/ --audio recordings/

Samples go to out/samples, the results to out/PROTOCOL.json and the table to out/PROTOCOL.md. The
papers take 200 samples of each sequence (multires) and 3 of each 10 s window (lda); --samples takes
fewer.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

# Alexanderson et al. 2023, Table 4: {metric: {row: value}}. FGD is given for two corpora of speech,
# all other metrics for dance.
LDA_TABLE = {
    "fgd (TSG)": {"GT": 9.94, "LDA": 25.77, "LDA-DW": 126.92, "SG": 118.61},
    "fgd (ZeroEGGS)": {"GT": 31.84, "LDA": 59.07, "LDA-G": 47.68, "ZE": 52.99},
    "fid_k": {"GT": 3.00, "LDA": 6.62, "LDA-U": 7.69, "BL": 28.15},
    "fid_g": {"GT": 5.22, "LDA": 7.41, "LDA-U": 8.98, "BL": 12.70},
    "div_k": {"GT": 9.55, "LDA": 9.78, "LDA-U": 9.13, "BL": 5.22},
    "div_g": {"GT": 7.12, "LDA": 5.77, "LDA-U": 6.13, "BL": 4.35},
    "bas": {"GT": 0.2662, "LDA": 0.2559, "LDA-U": 0.2600, "BL": 0.2311},
}
WHY_NOT = {
    "multires": (
        "The paper's actress and its four SMPL sequences are not public; its threshold of coverage "
        'is "empirically chosen" and not printed, so that `--variant paper` has none unless '
        "you give it. Values depend on the rig, the sequence and its length. Only models "
        "trained on the same sequences can be ranked.",
    ),
    "lda": (
        "FGD: the paper's extractor is Yoon et al.'s, bound to a rig of ten upper-body joints; "
        "ours is fitted on your recordings (--features), and its scale is its own.",
        "FID and Div: measured on dance. FID_g and Div_g: constants of the released code (frame "
        "time, bone lengths) differ from its text, see gesturekit/evaluation/metrics/frechet.",
        "BAS: on music. Librosa finds beats in speech too, which mean less.",
        "What can be compared on any corpus is the order of GT and the models, and each value's "
        "ratio to the recordings'.",
    ),
}


def main(argv: list[str] | None = None) -> None:
    options = arguments(argv)
    out = options.out
    out.mkdir(parents=True, exist_ok=True)
    path = out / f"{options.protocol}.json"
    is_manifest = Path(options.recordings).suffix == ".jsonl"
    command = [sys.executable, "-m", "gesturekit", "evaluate", options.model]
    command += ["--corpus", options.recordings] if is_manifest else [options.recordings]
    if options.protocol == "lda":
        command += ["--bas", "bailando", "--kinetic", "released"]
    command += ["--protocol", options.protocol, "--samples", str(options.samples)]
    command += ["--samples-dir", str(out / "samples"), "--existing", "replace", "--json", str(path)]
    for name in ("audio", "features"):
        if getattr(options, name) is not None:
            command += [f"--{name}", getattr(options, name)]
    if (out / "samples").is_dir():
        command[command.index("replace")] = "skip"
        path.unlink(missing_ok=True)
    done = subprocess.run(command, check=False)
    if done.returncode not in (0, 1):
        raise SystemExit(done.returncode)
    found = json.loads(path.read_text(encoding="utf-8"))
    text = table(options.protocol, found, options.samples)
    (out / f"{options.protocol}.md").write_text(text, encoding="utf-8")
    print(text)


def arguments(argv: list[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("protocol", choices=["multires", "lda"])
    parser.add_argument("model", help="model folder, or a folder of rendered samples")
    parser.add_argument("recordings", help="folder of recordings, or manifest of a corpus")
    parser.add_argument("--audio", help="folder of the recordings' sound")
    parser.add_argument("--features", help="extractor of gesturekit fit-features, for FGD")
    parser.add_argument("--samples", type=int, default=3, help="of each sequence or window")
    parser.add_argument("--out", type=Path, default=Path("out"))
    return parser.parse_args(argv)


def table(protocol: str, found: Mapping[str, Any], samples: int) -> str:
    """Return the table in Markdown, with what cannot be compared."""
    lines = [f"# Evaluation of the paper: {protocol}, {samples} samples each", ""]
    lines += multires_rows(found) if protocol == "multires" else lda_rows(found)
    lines += ["", "What cannot be compared:", ""]
    return "\n".join([*lines, *(f"- {reason}" for reason in WHY_NOT[protocol]), ""])


def multires_rows(found: Mapping[str, Any]) -> list[str]:
    """Return Table 1 of Moreno-Villamarín et al. 2024: a row for each sequence."""
    keys = ("coverage", "global_diversity", "local_diversity")
    names = ("Coverage, %", "Global diversity", "Local diversity")
    (model,) = found["models"]
    lines = [f"| sequence | {' | '.join(names)} |", "|---|---:|---:|---:|"]
    for stem, figures in model["by_recording"].items():
        lines.append(f"| {stem} | {' | '.join(_number(figures.get(key)) for key in keys)} |")
    figures = model["figures"]
    lines.append(f"| **mean** | {' | '.join(_number(figures.get(key)) for key in keys)} |")
    return [
        *lines,
        "",
        "The printed values of Table 1 are in the paper; they are not repeated here.",
    ]


def lda_rows(found: Mapping[str, Any]) -> list[str]:
    """Return Table 4 of Alexanderson et al. 2023, with our recordings and model first."""
    (model,) = found["models"]
    lines = [
        "| metric | our recordings | our model | ratio | paper: GT | paper: LDA | ratio |",
        "|---|---:|---:|---:|---:|---:|---:|",
    ]
    for name, paper in LDA_TABLE.items():
        figure = model["figures"].get(name.split()[0])
        ours, own = (None, None) if figure is None else (figure["value"], figure["recording"])
        cells = [_plain(own), _number(figure), _ratio(ours, own)]
        cells += [_plain(paper["GT"]), _plain(paper["LDA"]), _ratio(paper["LDA"], paper["GT"])]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return lines


def _number(figure: Mapping[str, Any] | None) -> str:
    if figure is None:
        return "–"
    low, high = figure["low"], figure["high"]
    spread = "" if low is None else f" [{_plain(low)}, {_plain(high)}]"
    return f"{_plain(figure['value'])}{spread}"


def _plain(value: float | None) -> str:
    return "–" if value is None else f"{value:.3g}"


def _ratio(value: float | None, own: float | None) -> str:
    return f"{value / own:.2f}" if value is not None and own else "–"


if __name__ == "__main__":
    main()
