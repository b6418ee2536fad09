"""Public corpora in tiny folders of the published shape."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

Write = Callable[..., None]
"""Write(path, seconds, fps=30, seed=0): a motion or a sound."""

WORDS = """File type = "ooTextFile"
Object class = "TextGrid"

0 2 <exists> 1
"IntervalTier" "words" 0 2 1
0.5
0.8
"hello"
"""


def write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def write_smplx(path: Path, seconds: float, seed: int, **changes: object) -> None:
    rng, n = np.random.default_rng(seed), round(30 * seconds)
    phase = rng.uniform(0, 6, 165) + np.arange(n)[:, None] / 10
    poses = 0.1 * np.sin(phase)
    poses[:, 3 * 16 + 2] -= 1.2  # the arms hang
    poses[:, 3 * 17 + 2] += 1.2
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {
        "poses": poses,
        "trans": np.tile([0.0, 1.2, 0.0], (n, 1)),
        "expressions": np.zeros((n, 100)),
        "betas": np.zeros(300),
        "gender": "neutral",
        "model": "smplx2020",
        "mocap_frame_rate": 30,
    }
    np.savez(path, **arrays | changes)


def beat2(root: Path, motion: Write, sound: Write, seconds: float = 1.5) -> None:
    ids = {
        "2_scott_0_1_1": "train",
        "2_scott_0_65_65": "val",
        "1_wayne_0_86_87": "test",
        "1_wayne_0_103_103": "train",
        "30_katya_1_9_9": "additional",
    }
    for seed, name in enumerate(ids):
        write_smplx(root / "smplxflame_30" / f"{name}.npz", seconds, seed)
        sound(root / "wave16k" / f"{name}.wav", seconds + 0.5)
        write(root / "textgrid" / f"{name}.TextGrid", WORDS)
        write(root / "sem" / f"{name}.txt", "beat_align\t0.2\t0.9\t0.7\t0.4\thello\n")
    rows = "".join(f"{name},{split}\n" for name, split in ids.items())
    write(root / "train_test_split.csv", f"id,type\n{rows}")


INFO = (
    "audio_filename,audio_start_time,anim_start_time,style,acting_start_time,acting_end_time,"
    "anim_bvh,validation\n"
)


def info_row(take: str, style: str, validation: str, acting: str = "09:00:03:30") -> str:
    times = f"09:00:01:15  ,09:00:02:30,{style},{acting},09:00:05:00"
    return (
        f"{take}.wav,{times},{take}.bvh,{validation}\n{take}.wav,{times},{take}_mirror.bvh,TRUE\n"
    )


def zeggs(root: Path, motion: Write, sound: Write, seconds: float = 1.0) -> None:
    """Clean recordings of three takes."""
    takes = {"001_Neutral_0": "FALSE", "005_Neutral_4": "TRUE", "067_Speech_2": "TRUE"}
    for seed, take in enumerate(takes):
        motion(root / "clean" / f"{take}_x_1_0.bvh", seconds, 60.0, seed=seed)
        sound(root / "clean" / f"{take}_x_1_0.wav", seconds)
    rows = "".join(info_row(take, take.split("_")[1], v) for take, v in takes.items())
    write(root / "info.csv", INFO + rows)


def genea2023(root: Path, motion: Write, sound: Write, seconds: float = 1.0) -> None:
    fingers = {"000": "finger_incl", "001": "finger_not_incl"}
    for split, names in {"trn": ("000", "001"), "val": ("000",), "tst": ("000",)}.items():
        table = "prefix,main-agent_id,main-agent_has_finger,interloctr_id,interloctr_has_finger\n"
        for name in names:
            for who in ("main-agent", "interloctr"):
                here, stem = root / split / who, f"{split}_2023_v0_{name}_{who}"
                sound(here / "wav" / f"{stem}.wav", seconds)
                write(here / "tsv" / f"{stem}.tsv", "0.1\t0.3\thi\n0.4\t0.6\t#laugh\n")
                if (split, who) != ("tst", "main-agent"):
                    motion(here / "bvh" / f"{stem}.bvh", seconds)
            table += f"{split}_2023_v0_{name},{int(name) + 1},{fingers[name]},9,finger_incl\n"
        write(root / split / "metadata.csv", table)


DANCES = tuple(
    f"kthstreet_{genre}_sFM_cAll_{dancer}_mLO_ch01_song_00{n}"
    for n, (genre, dancer) in enumerate((("gLO", "d02"), ("gPO", "d01"), ("gPO", "d02")))
)


def motorica(root: Path, motion: Write, sound: Write, seconds: float = 1.0) -> None:
    """Three dances, of which the last has no music."""
    for seed, name in enumerate(DANCES):
        motion(root / "bvh" / f"{name}.bvh", seconds, 120.0, seed=seed)
    for name in DANCES[:2]:
        sound(root / "wav" / f"{name}.wav", seconds)


def style100(root: Path, motion: Write, sound: Write, seconds: float = 2.0) -> None:
    """Two styles of which BR and ID have cuts that begin at 0.1 and 0.2 s."""
    gaits = ("BR", "BW", "FR", "FW", "ID", "SR", "SW", "TR1", "TR2", "TR3")
    header = ",".join(["STYLE_NAME", *(f"{g}_{end}" for g in gaits for end in ("START", "STOP"))])
    cells = {"BR": f"6,{round(30 * seconds)}", "FW": "", "ID": f"12,{round(45 * seconds)}"}
    row = ",".join(cells.get(gait, "") or "," for gait in gaits)
    write(root / "Frame_Cuts.csv", f"{header}\nAngry,{row}\nOld,{row}\n")
    for style, gait in (("Angry", "BR"), ("Angry", "FW"), ("Angry", "ID"), ("Old", "BR")):
        motion(root / style / f"{style}_{gait}.bvh", seconds, 60.0)


def trinity(root: Path, motion: Write, sound: Write, seconds: float = 1.0) -> None:
    for n in ("001", "008", "009"):
        motion(root / "source" / "bvh" / f"Recording_{n}.bvh", seconds, 60.0)
        sound(root / "source" / "audio" / f"Recording_{n}.wav", seconds)
