"""transformers' own WavLM with weights of any layout: the reference for the fast implementation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch

from audio_features.huggingface.front_ends import Convolutions
from audio_features.huggingface.layers import Layers

if TYPE_CHECKING:
    from audio_features.wavlm.architecture import Architecture


def reference(
    shape: Architecture, tensors: dict[str, torch.Tensor], top: int
) -> tuple[Convolutions, Layers]:
    """Return the convolutions and the layers up to `top` of transformers' WavLMModel.

    Args:
        shape: architecture of the network.
        tensors: its tensors by transformers' names; the network is on their device.
        top: highest hidden state that is needed.
    """
    from transformers import WavLMConfig, WavLMModel

    config = WavLMConfig(
        hidden_size=shape.width,
        num_hidden_layers=shape.layers,
        num_attention_heads=shape.heads,
        intermediate_size=shape.inner,
        feat_extract_norm=shape.front_norm,
        do_stable_layer_norm=shape.pre_norm,
        conv_dim=shape.channels,
        conv_kernel=shape.kernels,
        conv_stride=shape.strides,
        conv_bias=shape.conv_bias,
        num_conv_pos_embeddings=shape.position_kernel,
        num_conv_pos_embedding_groups=shape.position_groups,
        num_buckets=shape.buckets,
        max_bucket_distance=shape.max_distance,
        layer_norm_eps=shape.eps,
        mask_time_prob=0.0,
        mask_feature_prob=0.0,
    )
    with torch.random.fork_rng(devices=[]), torch.device("meta"):
        network = WavLMModel(config)
    network.load_state_dict(tensors, assign=True)
    network.eval().requires_grad_(False)
    return Convolutions(config, network), Layers(network, top)
