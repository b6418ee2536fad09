"""Published feature extractors of the Fréchet gesture distance, read from their weight files.

- BEAT2 (EMAGE, Liu et al. 2024; `AESKConv_240_100.bin` of its evaluation tools): `SkeletonEncoder`,
  for motion on the SMPL-X rig. Nothing but the file is needed, and values are those of the papers.
- GENEA and Yoon et al. 2020 (`model_checkpoint_60.bin`, `gen_dict`): `pose_autoencoder`, whose
  windows of poses are normalised by a reference set (`FeatureModel.of_weights`), as the files do
  not hold the normalisation of their own rig.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from audio_features import AudioFeaturesError
from audio_features.weight_files import plain_tensors, read_file
from gesturekit.errors import EvaluationError
from gesturekit.evaluation.metrics.frame_rate import at_rate
from gesturekit.evaluation.metrics.frechet.autoencoder import PoseAutoencoder
from gesturekit.evaluation.metrics.frechet.poses import LEAST_FRAMES, MOST_FRAMES, motion_name
from gesturekit.motion import Motion
from gesturekit.motion.rotations import matrix_from_quaternion

_FPS = 30.0
_FRAMES = 32  # a multiple of which BEAT2's evaluation encodes
_JOINTS = 55
_GROUPS = 10
# Modules of `PoseAutoencoder` by their names in the published files.
_LAYERS = {
    "pose_encoder.net.": {"0.0": 0, "0.1": 1, "1.0": 3, "1.1": 4, "2.0": 6, "2.1": 7, "3": 9},
    "pose_encoder.out_net.": {"0": 11, "1": 12, "3": 13, "4": 14, "6": 15},
    "pose_encoder.": {"fc_mu": 16},
    "decoder.pre_net.": {"0": 0, "1": 1, "3": 2},
    "decoder.net.": {"0": 4, "1": 5, "3": 7, "4": 8, "6": 10, "7": 11},
}


def read_weights(path: Path) -> dict[str, Tensor]:
    """Return the tensors of a safetensors file or of a torch state dict; no code in it is run.

    Raises:
        EvaluationError: it cannot be read, or holds no table of tensors.
    """
    try:
        content = read_file(path)
        for name in ("model_state", "gen_dict", "state_dict"):
            if isinstance(content, Mapping) and isinstance(content.get(name), Mapping):
                content = content[name]
        tensors = plain_tensors(path, content)
    except (AudioFeaturesError, OSError) as error:
        raise EvaluationError(str(error)) from None
    return {name.removeprefix("module."): tensor for name, tensor in tensors.items()}


def pose_autoencoder(path: Path) -> PoseAutoencoder:
    """Return the autoencoder of GENEA's or Yoon's weight file; GENEA's lacks `fc_mu`.

    Raises:
        EvaluationError: it cannot be read, or has other tensors.
    """
    tensors = read_weights(path)
    named: dict[str, Tensor] = {}
    for prefix, layers in _LAYERS.items():
        for layer, number in layers.items():
            inside = f"{prefix}{layer}."
            for name in (name for name in tensors if name.startswith(inside)):
                part = "encoder" if prefix.startswith("pose") else "decoder"
                named[f"{part}.{number}.{name.removeprefix(inside)}"] = tensors[name].float()
    try:
        n_inputs, n_frames = named["encoder.0.weight"].shape[1], len(named["decoder.2.weight"]) // 4
        if not LEAST_FRAMES <= n_frames <= MOST_FRAMES:
            raise IndexError(f"windows of {n_frames} frames")
        network = PoseAutoencoder(n_inputs, n_frames, "encoder.16.weight" in named)
        network.load_state_dict(named)
    except (KeyError, IndexError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:200]
        raise EvaluationError(
            f"{path}: not GENEA's or Yoon's pose autoencoder ({reason}); it has "
            f"{', '.join(list(tensors)[:4]) or 'no tensors'}"
        ) from None
    return network


class SkeletonEncoder:
    """BEAT2's encoder of SMPL-X poses, for the FGD of its papers.

    Poses are the first two rows of the local rotation matrices of 55 joints, at 30 fps. Layers are
    tanh(pool(GroupNorm(conv(x)) + shortcut(x))): a convolution and a shortcut with stride 2, both
    masked to neighbouring joints, ten groups, and a mean over joints where there is a pool.
    As in the published evaluation, a motion is encoded whole, cut to a multiple of 32 frames: the
    normalisation is over time, so that features depend on the length of clips.
    """

    windows = None  # `raw_fgd` fits its own

    def __init__(self, tensors: Mapping[str, Tensor]) -> None:
        self._tensors = {name: tensor.float() for name, tensor in tensors.items()}

    @classmethod
    def load(cls, path: Path) -> SkeletonEncoder:
        """Read BEAT2's weights; the decoder is left out.

        Raises:
            EvaluationError: it cannot be read, or has other tensors.
        """
        tensors = read_weights(path)
        start = "encoder.layers."
        encoder = cls({k.removeprefix(start): t for k, t in tensors.items() if k.startswith(start)})
        try:
            encoder._features(torch.zeros(1, 6 * _JOINTS, _FRAMES))
        except (KeyError, RuntimeError, IndexError) as error:
            raise EvaluationError(
                f"{path}: not BEAT2's skeleton encoder of {_JOINTS} joints "
                f"({' '.join(str(error).split())[:200]}); weights of GENEA's layout need "
                "recordings: gesturekit fit-features RECORDINGS --weights FILE"
            ) from None
        return encoder

    @property
    def fingerprint(self) -> str:
        """SHA-256 of the tensors; values of equal ones can be compared."""
        digest = hashlib.sha256(b"BEAT2")
        for name, tensor in sorted(self._tensors.items()):
            digest.update(f"{name} {tuple(tensor.shape)}".encode())
            digest.update(tensor.contiguous().numpy().tobytes())
        return digest.hexdigest()

    @torch.no_grad()
    def encode(self, motions: Sequence[Motion]) -> list[np.ndarray]:
        """Return (T / 16, D) features of each motion at 30 fps; skip motions below 32 frames.

        Raises:
            EvaluationError: a motion is not on the SMPL-X rig, or none has 32 frames.
        """
        features = []
        for motion in motions:
            if motion.skeleton.n_joints != _JOINTS or "jaw" not in motion.skeleton.names:
                raise EvaluationError(
                    f"{motion_name(motion)}: BEAT2's extractor takes the {_JOINTS} joints of SMPL-X"
                )
            motion = at_rate(motion, _FPS)
            n = motion.n_frames - motion.n_frames % _FRAMES
            if n:
                rows = matrix_from_quaternion(motion.rotations[:n])[..., :2, :].reshape(1, n, -1)
                poses = torch.from_numpy(rows.astype(np.float32)).transpose(1, 2)
                features.append(self._features(poses)[0].T.double().numpy())
        if not features:
            raise EvaluationError(f"none of {len(motions)} motions has {_FRAMES} frames at 30 fps")
        return features

    def _features(self, poses: Tensor) -> Tensor:
        """Return features (B, D, T / 16) of poses (B, 330, T)."""
        for layer in range(4):
            w = {n[4:]: t for n, t in self._tensors.items() if n.startswith(f"{layer}.0.")}
            kernel = w["residual.0.weight"] * w["residual.0.mask"]
            padded = F.pad(poses, ((kernel.shape[2] - 1) // 2,) * 2)
            made = F.conv1d(padded, kernel, w["residual.0.bias"], stride=2)
            made = F.group_norm(made, _GROUPS, w["residual.1.weight"], w["residual.1.bias"])
            direct = w["shortcut.weight"] * w["shortcut.mask"]
            made = made + F.conv1d(poses, direct, w["shortcut.bias"], stride=2)
            if "common.0.weight" in w:
                made = w["common.0.weight"] @ made
            poses = torch.tanh(made)
        return poses
