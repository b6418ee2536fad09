"""What every test may use: real recordings where they are, and small ones made on the spot."""

from __future__ import annotations

import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import soundfile
from scipy.spatial.transform import Rotation

from gesturekit.motion import Motion, Skeleton

SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real recordings that lies beside a developer's checkout."""
    if not SHARED_DATA.is_dir():
        pytest.skip("real recordings not found at ../shared/data")
    return SHARED_DATA


JOINTS = {
    "Hips": (None, (0.0, 0.0, 0.0)),
    "Spine": ("Hips", (0.0, 0.1, 0.0)),
    "Chest": ("Spine", (0.0, 0.2, 0.0)),
    "Neck": ("Chest", (0.0, 0.2, 0.0)),
    "Head": ("Neck", (0.0, 0.1, 0.0)),
    "LeftShoulder": ("Chest", (0.05, 0.15, 0.0)),
    "LeftArm": ("LeftShoulder", (0.12, 0.0, 0.0)),
    "LeftForeArm": ("LeftArm", (0.28, 0.0, 0.0)),
    "LeftHand": ("LeftForeArm", (0.25, 0.0, 0.0)),
    "RightShoulder": ("Chest", (-0.05, 0.15, 0.0)),
    "RightArm": ("RightShoulder", (-0.12, 0.0, 0.0)),
    "RightForeArm": ("RightArm", (-0.28, 0.0, 0.0)),
    "RightHand": ("RightForeArm", (-0.25, 0.0, 0.0)),
    "LeftUpLeg": ("Hips", (0.1, -0.05, 0.0)),
    "LeftLeg": ("LeftUpLeg", (0.0, -0.42, 0.0)),
    "LeftFoot": ("LeftLeg", (0.0, -0.42, 0.0)),
    "RightUpLeg": ("Hips", (-0.1, -0.05, 0.0)),
    "RightLeg": ("RightUpLeg", (0.0, -0.42, 0.0)),
    "RightFoot": ("RightLeg", (0.0, -0.42, 0.0)),
}


@pytest.fixture(scope="session")
def skeleton() -> Skeleton:
    names = tuple(JOINTS)
    return Skeleton(
        names=names,
        parents=tuple(
            -1 if parent is None else names.index(parent) for parent, _ in JOINTS.values()
        ),
        offsets=np.array([offset for _, offset in JOINTS.values()]),
        end_sites={
            "Head": (np.array([0.0, 0.15, 0.0]),),
            "LeftHand": (np.array([0.1, 0.0, 0.0]),),
            "RightHand": (np.array([-0.1, 0.0, 0.0]),),
            "LeftFoot": (np.array([0.0, -0.05, 0.15]),),
            "RightFoot": (np.array([0.0, -0.05, 0.15]),),
        },
        rotation_orders=("ZXY",) * len(names),
    )


@pytest.fixture(scope="session")
def gesture(skeleton: Skeleton) -> Callable[..., Motion]:
    """gesture(seconds, fps=30, t_pose=0, seed=0): arms hang and swing, after a held T-pose."""

    def make(seconds: float, fps: float = 30.0, *, t_pose: int = 0, seed: int = 0) -> Motion:
        n = int(np.floor(seconds * fps + 0.5))
        time = np.arange(n) / fps
        phase = np.random.default_rng(seed).uniform(0, 2 * np.pi, (skeleton.n_joints, 3))
        angles = 0.15 * np.sin(2.0 * np.pi * 0.7 * time[:, None, None] + phase)
        angles[:, skeleton.index("LeftArm"), 2] -= 1.3
        angles[:, skeleton.index("RightArm"), 2] += 1.3
        angles[:t_pose] = 0.0
        rotations = Rotation.from_euler("xyz", angles.reshape(-1, 3)).as_quat()
        return Motion(
            skeleton,
            rotations.reshape(n, skeleton.n_joints, 4),
            np.tile([0.0, 0.9, 0.0], (n, 1)),
            fps,
        )

    return make


@pytest.fixture(scope="session")
def write_speech() -> Callable[..., Path]:
    """write_speech(path, seconds, rate=16000): noise in bursts of a fifth of a second."""

    def write(path: Path, seconds: float, rate: int = 16000, *, level: float = 0.2) -> Path:
        time = np.arange(round(seconds * rate)) / rate
        noise = np.random.default_rng(0).standard_normal(len(time))
        path.parent.mkdir(parents=True, exist_ok=True)
        soundfile.write(path, level * noise * (np.sin(2 * np.pi * 2.5 * time) > 0), rate)
        return path

    return write


@pytest.fixture(scope="session")
def write_pair(gesture, write_speech) -> Callable[..., tuple[Path, Path]]:
    """write_pair(folder, stem, seconds=4): STEM.wav and STEM.bvh that belong together."""

    def write(folder: Path, stem: str, seconds: float = 4.0, **options) -> tuple[Path, Path]:
        audio = write_speech(folder / f"{stem}.wav", seconds)
        motion = folder / f"{stem}.bvh"
        gesture(seconds, **options).save(motion)
        return audio, motion

    return write


@pytest.fixture(scope="session")
def corpus(tmp_path_factory, write_pair, write_speech) -> Path:
    """A manifest of two recordings of different lengths (6 and 2.5 s) and unpaired speech."""
    from gesturekit.corpus import prepare

    folder = tmp_path_factory.mktemp("corpus")
    write_pair(folder / "paired", "a", 6.0, seed=1)
    write_pair(folder / "paired", "b", 2.5, seed=2)
    write_speech(folder / "more" / "c.wav", 5.0, level=0.1)
    manifest = folder / "corpus.jsonl"
    prepare([folder / "paired"], manifest, unpaired=[folder / "more"], holdout=0.0)
    return manifest


@pytest.fixture(scope="session")
def write_wavlm() -> Callable[..., Any]:
    """write_wavlm(folder, seed=0, norm="group"): a tiny WavLM of random weights, as Hugging Face
    saves them; norm "layer" is the front end of the Large models. Returns the model."""
    import torch
    import transformers

    def write(folder: Path, seed: int = 0, norm: str = "group") -> Any:
        torch.manual_seed(seed)
        config = transformers.WavLMConfig(
            hidden_size=32,
            num_hidden_layers=3,
            num_attention_heads=4,
            intermediate_size=64,
            conv_dim=[16] * 7,
            num_conv_pos_embeddings=16,
            num_conv_pos_embedding_groups=4,
            feat_extract_norm=norm,
            do_stable_layer_norm=norm == "layer",
        )
        model = transformers.WavLMModel(config).eval()
        model.save_pretrained(folder)
        return model

    return write


@pytest.fixture
def no_network(monkeypatch) -> None:
    """Any attempt to reach the network fails the test."""

    def refuse(*args: object, **kwargs: object) -> None:
        raise AssertionError("the network was reached for")

    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(socket, "getaddrinfo", refuse)
