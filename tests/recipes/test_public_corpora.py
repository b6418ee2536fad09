"""Recipes for public corpora, from a tiny folder in the published shape to a model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from gesturekit.training.config import read_chain
from gesturekit.training.recipes import find_config, read_table, recipes

SECONDS = 4.0


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def beat2(root: Path, pair: Callable[..., None]) -> None:
    time = np.arange(round(30 * SECONDS))[:, None]
    for name in ("2_scott_0_1_1", "2_scott_0_65_65"):
        pair(root / "motion", root / "wave16k", name)
        write(root / "textgrid" / f"{name}.TextGrid", TEXTGRID)
        poses = 0.1 * np.sin(np.arange(165) + time / 10)
        (root / "smplxflame_30").mkdir(exist_ok=True)
        np.savez(
            root / "smplxflame_30" / f"{name}.npz",
            poses=poses,
            trans=np.tile([0.0, 1.2, 0.0], (len(time), 1)),
            betas=np.zeros(300),
            gender="neutral",
            model="smplx2020",
            mocap_frame_rate=30,
        )
    write(root / "train_test_split.csv", "id,type\n2_scott_0_1_1,train\n2_scott_0_65_65,test\n")


TEXTGRID = """File type = "ooTextFile"
Object class = "TextGrid"

0
4
<exists>
1
"IntervalTier"
"words"
0
4
1
0.5
0.8
"hello"
"""


def zeggs(root: Path, pair: Callable[..., None]) -> None:
    rows = "audio_filename,audio_start_time,anim_start_time,style,acting_start_time,"
    rows += "acting_end_time,anim_bvh,validation\n"
    for take, validation in (("001_Neutral_0", "FALSE"), ("002_Happy_0", "FALSE")):
        pair(root / "clean", root / "clean", f"{take}_x_1_0", 60.0)
        times = "09:00:00:00,09:00:00:00,{},09:00:00:00,09:00:04:00"
        rows += f"{take}.wav,{times.format(take.split('_')[1])},{take}.bvh,{validation}\n"
    write(root / "info.csv", rows)


def genea2023(root: Path, pair: Callable[..., None]) -> None:
    head = "prefix,main-agent_id,main-agent_has_finger,interloctr_id,interloctr_has_finger\n"
    for split in ("trn", "val"):
        here = root / split / "main-agent"
        pair(here / "bvh", here / "wav", f"{split}_2023_v0_000_main-agent")
        write(here / "tsv" / f"{split}_2023_v0_000_main-agent.tsv", "0.1\t0.3\thi\n")
        write(
            root / split / "metadata.csv",
            f"{head}{split}_2023_v0_000,1,finger_incl,9,finger_incl\n",
        )


def motorica(root: Path, pair: Callable[..., None]) -> None:
    for genre in ("gLO", "gPO"):
        name = f"kthstreet_{genre}_sFM_cAll_d02_mLO_ch01_song_001"
        pair(root / "bvh", root / "wav", name, 120.0)


def style100(root: Path, pair: Callable[..., None]) -> None:
    gaits = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")
    header = ",".join(["STYLE_NAME", *(f"{g}_{end}" for g in gaits for end in ("START", "STOP"))])
    cuts = ",".join(["0,239", *[","] * 9])
    write(root / "Frame_Cuts.csv", f"{header}\nAngry,{cuts}\nOld,{cuts}\n")
    for style in ("Angry", "Old"):
        pair(root / style, root / "unused", f"{style}_BR", 60.0)


def trinity(root: Path, pair: Callable[..., None]) -> None:
    for number in ("001", "008"):
        source = root / "source"
        pair(source / "bvh", source / "audio", f"Recording_{number}", 60.0)


CORPORA = {
    "beat2": ("beat2", beat2),
    "zeggs": ("zeggs", zeggs),
    "genea2023": ("genea2023", genea2023),
    "dance_motorica": ("motorica", motorica),
    "path_100style": ("100style", style100),
    "gestures_trinity": ("trinity", trinity),
}


@pytest.mark.parametrize("recipe", CORPORA)
def test_from_the_published_folder_to_a_model(recipe, gesturekit, gesture, write_speech, tmp_path):
    layout, make = CORPORA[recipe]

    def pair(motions: Path, sounds: Path, name: str, fps: float = 30.0) -> None:
        motions.mkdir(parents=True, exist_ok=True)
        gesture(SECONDS, fps).save(motions / f"{name}.bvh")
        write_speech(sounds / f"{name}.wav", SECONDS)

    root, corpus = tmp_path / "published", tmp_path / "corpus.jsonl"
    root.mkdir()
    make(root, pair)
    # 1 where something is left out, such as the other gaits of 100STYLE.
    prepare = ("prepare", root, "--layout", layout, "--holdout", 0, "--out", corpus)
    assert gesturekit(*prepare).status in (0, 1)
    system = read_chain(find_config(recipe))["system"]
    flags = [*read_table()["debug"][system], *recipes()[recipe].debug.get("config", ())]
    train = ("train", recipe, f"corpus={corpus}", f"out={tmp_path / 'run'}", *flags)
    assert gesturekit(*train).status == 0
    assert (tmp_path / "run" / "model" / "model.safetensors").is_file()
