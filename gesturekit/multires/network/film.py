"""Feature-wise linear modulation (FiLM) by speech and style (section 3.3, eqs. 8 to 10)."""

from __future__ import annotations

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from gesturekit.motion.parts import unidentified, upper_body
from gesturekit.multires.config import NetworkConfig
from gesturekit.multires.motion_vector import MultiresRepresentation


class Film(nn.Module):
    """Modulation of chosen channels, gamma * x + delta (eqs. 8 to 10).

    gamma = 1 + f(y) and delta = h(y), both per frame. f and h are initialised to zero, so that an
    untrained modulation is the identity. Other channels are not changed.

    Args:
        embedding: channels of y.
        channels: (C,) bool, True for modulated channels.
    """

    index: Tensor

    def __init__(self, embedding: int, channels: np.ndarray) -> None:
        super().__init__()
        index = torch.zeros(len(channels), dtype=torch.long)
        index[torch.from_numpy(channels)] = torch.arange(1, int(channels.sum()) + 1)
        # Channel 0 of the padded gain and shift is zero; every channel not modulated points at it.
        self.register_buffer("index", index, persistent=False)
        self.gain = nn.Conv1d(embedding, int(channels.sum()), 1)
        self.shift = nn.Conv1d(embedding, int(channels.sum()), 1)
        for layer in (self.gain, self.shift):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)

    def forward(self, x: Tensor, y: Tensor) -> Tensor:
        """Return x (B, C, T) modulated by y (B, embedding, T)."""
        gamma = F.pad(self.gain(y), (0, 0, 1, 0)).index_select(1, self.index)
        delta = F.pad(self.shift(y), (0, 0, 1, 0)).index_select(1, self.index)
        return x + x * gamma + delta


def modulated_blocks(representation: MultiresRepresentation, config: NetworkConfig) -> np.ndarray:
    """Return (blocks,) bool, True for blocks that the condition modulates.

    Contacts and the root's displacement are modulated only with `modulate: all`. If the upper body
    of a rig cannot be identified, `upper` modulates every block too.
    """
    skeleton, n_blocks = representation.skeleton, len(representation.block_sizes)
    if config.modulate == "all" or (config.modulate == "upper" and unidentified(skeleton)):
        return np.ones(n_blocks, dtype=bool)
    if config.modulate == "upper":
        names = set(upper_body(skeleton))
    else:
        names = {skeleton.names[skeleton.index(name)] for name in config.modulate}
    joints = [name in names for name in representation.joints]
    return np.array(joints + [False] * (n_blocks - len(joints)))
