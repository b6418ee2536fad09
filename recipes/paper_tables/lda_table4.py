"""Table 4 of Alexanderson et al. 2023: a block a corpus, a row a model.

    python recipes/paper_tables/lda_table4.py \\
        --block TSG tsg.jsonl LDA=runs/tsg/model LDA-DW=runs/dw/model SG=samples/stylegestures \\
        --block dance dances.jsonl LDA=runs/dance/model LDA-U=lda_u

A row is a model folder, or a folder of motion of another system, named like the samples here
(ID_w000_s1.bvh: window 0 of item ID, sample 1). A label that ends in -G is sampled with guidance
1.5; LDA-G=MODEL+OTHER takes OTHER as the unconditional model. Samples are kept in out/samples.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from cells import PUBLISHED, markdown, number, share_trained

import gesturekit as gk
from gesturekit.corpus import Manifest
from gesturekit.evaluation import FeatureModel, Variants
from gesturekit.rendering.samples import SamplingOptions, sample_lda

ROWS = {
    "TSG": {
        "LDA": "train diffusion_speech/tsg",
        "LDA-DW": "train diffusion_speech/lda_dw",
        "SG": "sample StyleGestures (BVH) with its own code",
    },
    "ZeroEGGS": {
        "LDA": "train diffusion_speech/config",
        "LDA-G": "give LDA's model, trained with style dropout or beside an unconditional one",
        "ZE": "sample ZeroEGGS (BVH) with its own code",
    },
    "dance": {
        "LDA": "train diffusion_speech/dance, or gesturekit convert-checkpoint dance_LDA.ckpt",
        "LDA-U": "train diffusion_speech/dance_unconditional, or convert dance_LDA-U.ckpt",
        "BL": "sample Bailando with its own code; its joints become motion as the README says",
    },
}
"""Rows of the paper's blocks, and where a missing one comes from."""
METRICS = {
    "fgd": "FGD",
    "fid_k": "FID_k",
    "fid_g": "FID_g",
    "div_k": "Div_k",
    "div_g": "Div_g",
    "bas": "BAS",
}
GUIDANCE = 1.5


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--block", nargs="+", action="append", required=True, metavar="NAME CORPUS LABEL=MODEL"
    )
    parser.add_argument("--split", default="test")
    parser.add_argument("--samples", type=int, default=3, help="of each 10 s window (paper: 3)")
    parser.add_argument("--steps", type=int, help="denoising steps; all by default")
    parser.add_argument("--features", type=Path, help="of gesturekit fit-features, for FGD")
    parser.add_argument("--out", type=Path, default=Path("out/table4"))
    asked = parser.parse_args(argv)
    asked.out.mkdir(parents=True, exist_ok=True)
    text = "\n".join(block(asked, name, corpus, given) for name, corpus, *given in asked.block)
    (asked.out / "table4.md").write_text(text, encoding="utf-8")
    print(text)


def block(asked: argparse.Namespace, name: str, corpus: str, given: Sequence[str]) -> str:
    """Return the rows of a corpus and their caption."""
    models = dict(each.partition("=")[::2] for each in given)
    folders, shares = {}, []
    for label, model in models.items():
        folder, share = sampled(asked, name, corpus, label, model)
        folders[label] = folder
        shares.append(f"{label} {share}")
    found: dict[str, Mapping[str, Any]] = {}
    dashes: list[str] = []
    if folders:
        features = None if asked.features is None else FeatureModel.load(asked.features)
        variants = Variants(bas="bailando", kinetic="released")
        evaluation = gk.evaluate(
            folders, corpus, split=asked.split, protocol="lda", features=features, variants=variants
        )
        measured = evaluation.to_json()["models"]
        found = {model["label"]: model["figures"] for model in measured}
        dashes = [
            f"{model['label']}, {excluded['what']}: {excluded['reason']}."
            for model in measured
            for excluded in model["excluded"]
            if excluded["what"] in METRICS.values()
        ]
    rows, missing = [], []
    if found:
        first = next(iter(found.values()))
        rows.append(["GT", *(number((first.get(key) or {}).get("recording")) for key in METRICS)])
    for label in dict.fromkeys([*ROWS.get(name, {}), *models]):
        figures = found.get(label)
        if figures is None:
            missing.append(f"{label} (not given: {ROWS[name][label]})")
            continue
        cells = (figures.get(key) for key in METRICS)
        rows.append(
            [
                label,
                *(
                    number(*map(cell.get, ("value", "low", "high"))) if cell else "–"
                    for cell in cells
                ),
            ]
        )
    if asked.features is None:
        missing.append("FGD (give --features)")
    head = [name, *METRICS.values()]
    notes = [f"Trained: {'; '.join(shares)}."] if shares else []
    notes += [f"Missing: {'; '.join(missing)}."] if missing else []
    return "\n\n".join([markdown(head, rows).rstrip(), *notes, *dashes]) + "\n"


def sampled(
    asked: argparse.Namespace, name: str, corpus: str, label: str, model: str
) -> tuple[Path, str]:
    """Return the folder of a row's samples, made now if it is a model, and its share trained."""
    own, _, unconditional = model.partition("+")
    if not (Path(own) / "config.yaml").is_file():
        return Path(own), "by its own code"
    loaded, controls = gk.load(own), {}
    if asked.steps is not None:
        controls["steps"] = asked.steps
    if label.endswith("-G"):
        controls["guidance"] = GUIDANCE
        if unconditional:
            controls["unconditional"] = gk.load(unconditional)
    out = asked.out / "samples" / name / label
    items = Manifest.load(corpus).in_split(asked.split, corpus)
    options = SamplingOptions(samples=asked.samples, skip=True, controls=controls)
    for _ in sample_lda(loaded, items, out, options):
        pass
    return out, share_trained(Path(own), PUBLISHED.get(name))


if __name__ == "__main__":
    main()
