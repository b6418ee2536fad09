"""Figure 9 of Alexanderson et al. 2023: wrist speeds from one style to another (eq. 7).

    python recipes/paper_tables/lda_figure9.py runs/mine/model speech/ still happy [--out out]

For each gamma from -0.25 to 1.25 the model speaks every wav of the folder in the mixture of the two
styles, of weights 1 - gamma and gamma. Writes violins (figure9.png) and their quantiles.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from cells import PUBLISHED, markdown, number, share_trained
from matplotlib.figure import Figure

import audio_features as af
import gesturekit as gk
from gesturekit.evaluation import wrist_speed

GAMMAS = np.arange(-0.25, 1.26, 0.25)
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("model", type=Path)
    parser.add_argument("speech", type=Path, help="folder of wavs")
    parser.add_argument("first", help="style at gamma 0, such as still")
    parser.add_argument("second", help="style at gamma 1")
    parser.add_argument("--samples", type=int, default=5, help="of each wav (paper: 5)")
    parser.add_argument("--seconds", type=float, default=10.0, help="taken of each wav")
    parser.add_argument("--steps", type=int, help="denoising steps; all by default")
    parser.add_argument("--out", type=Path, default=Path("out/figure9"))
    asked = parser.parse_args(argv)
    model = gk.load(asked.model)
    waves = [af.Wave.load(path) for path in sorted(asked.speech.glob("*.wav"))]
    if not waves:
        raise SystemExit(f"{asked.speech}: no wav")
    waves = [wave.slice(0.0, min(asked.seconds, wave.duration)) for wave in waves]
    speeds = []
    for gamma in GAMMAS:
        style = f"{asked.first}:{1 - gamma:g},{asked.second}:{gamma:g}"
        controls = {"style": style, "raw": True, "steps": asked.steps}
        made = [
            model.generate(wave, seed=seed, item=str(k), **controls)
            for k, wave in enumerate(waves)
            for seed in range(asked.samples)
        ]
        speeds.append(np.concatenate([wrist_speed(motion) for motion in made]))
    asked.out.mkdir(parents=True, exist_ok=True)
    head = ["gamma", *(f"{100 * q:g} %" for q in QUANTILES)]
    rows = [
        [f"{gamma:g}", *map(number, np.quantile(values, QUANTILES))]
        for gamma, values in zip(GAMMAS, speeds, strict=True)
    ]
    caption = (
        f"Wrist speed, m/s, from {asked.first} to {asked.second}: {len(waves)} wavs, "
        f"{asked.samples} samples each; {share_trained(asked.model, PUBLISHED['ZeroEGGS'])}."
    )
    text = f"{caption}\n\n{markdown(head, rows)}"
    (asked.out / "figure9.md").write_text(text, encoding="utf-8")
    figure = Figure(figsize=(7, 3), layout="constrained")
    axes = figure.subplots()
    axes.violinplot(speeds, GAMMAS, widths=0.2, showmedians=True)
    axes.set(xlabel="gamma", ylabel="wrist speed, m/s", title=f"{asked.first} to {asked.second}")
    figure.savefig(asked.out / "figure9.png", dpi=120)
    print(text)


if __name__ == "__main__":
    main()
