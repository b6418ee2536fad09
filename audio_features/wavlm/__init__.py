"""WavLM: hidden states of a speech network as features, in memory linear in the sound's length.

The forward pass equals that of transformers. The front end turns samples into projected frames, in
blocks of any size with equal results; the encoder computes the hidden states.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import torch
from torch.nn import functional as F

from audio_features.errors import FeatureError
from audio_features.speech_encoders import HiddenStateExtractor, Layer, Options, checked_device
from audio_features.wavlm.weights import HOP, KERNELS, STRIDES, WINDOW, Architecture, read_weights

_BLOCK_FRAMES = 128
_MOMENT_FRAMES = 1 << 16
_NORM_EPS = 1e-5  # of the normalisations in the front end, in all three code bases
_GPU_BATCH = 8


class WavLM(HiddenStateExtractor):
    """Hidden states of WavLM (Chen et al. 2022), 50 frames per second.

    Frame t covers samples [320t, 320t + 400) at 16 kHz and is centred at 0.0125 + 0.02t seconds;
    a sound of N samples has floor((N - 400)/320) + 1 frames. Values agree with transformers'
    own forward pass to a relative 1e-5.

    Sounds of up to `full_context` seconds are processed whole. In longer sounds the convolutions
    are still exact, with Base's normalisation over the whole sound. The transformer processes
    overlapping chunks of equal length; the frames within `context` seconds of a chunk's edges
    are taken from its neighbours. This bounds the memory; values differ slightly from those of
    the whole sound.

    The level of the sound is unchanged, except for the normalisation that the weights expect,
    which is applied over the whole sound.

    Args:
        weights: Hugging Face's folder, Microsoft's WavLM-*.pt or a torchaudio state dict.
        layer: index into transformers' `hidden_states` (0 is the input of the first layer, k the
            output of the k-th); layers above it are not computed. "last" is the network's
            output. Several indices are concatenated; "mean" averages all states, {6: 1, 9: 3}
            takes a weighted mean (weights are scaled to sum to 1).
        dtype: "fp32", or "bf16" for matrix products in bfloat16: faster if the processor
            supports it, with a small error.
        fingerprint: fingerprint of the weights, as in a spec; other weights are refused.
        device: "cpu" or "cuda"; not part of the spec.
        final_norm: true applies Large's final normalisation to the topmost state (Base has
            none). By default it applies to "last", as in the output of all three code bases,
            and not to a number, as in transformers 5 and torchaudio's `extract_features`.
        options: any of
            normalize: None normalises the waveform as the weights expect; False leaves it
                unchanged; a number scales it to mean 0 and variance 1, with that number added to
                the variance (Hugging Face adds 1e-7, Microsoft 1e-5).
            full_context: longest sound that is processed whole, in seconds (300).
            chunk: longest chunk of longer sounds, in seconds (30). A sound is cut into as few
                chunks as possible, all of one length.
            context: part of a chunk that is context on either side, in seconds (5).

    Raises WeightsError if the weights cannot be used, FeatureError for an invalid setting.

    Examples:
        A spec does not hold the place of the weights:

        >>> af.extractor_from_spec({"kind": "wavlm", "layer": 6})
        Traceback (most recent call last):
        audio_features.errors.WeightsError: weights of WavLM are needed: name their place
        (features.weights=PATH to train, else --weights wavlm=PATH)
    """

    first, hop = WINDOW / 2, HOP

    def __init__(
        self,
        weights: str | os.PathLike[str],
        layer: Layer = "last",
        *,
        dtype: str = "fp32",
        fingerprint: str | None = None,
        device: str = "cpu",
        final_norm: bool | None = None,
        **options: Any,
    ) -> None:
        kinds = {"fp32": torch.float32, "bf16": torch.bfloat16}
        if dtype not in kinds:
            raise FeatureError(f"dtype={dtype!r}: 'fp32' or 'bf16'")
        settings, self._device = Options(**options), checked_device(device)
        self.weights, shape, tensors = read_weights(weights)
        self._choose(layer, final_norm, settings, fingerprint)
        tensors = {name: tensor.to(self._device) for name, tensor in tensors.items()}
        self._front = FrontEnd(shape, tensors, kinds[dtype])
        self._encoder = Encoder(shape, tensors, max(self._choice.indices), kinds[dtype])
        self.spec = {
            "kind": "wavlm",
            "layer": self._choice.spec,
            "final_norm": self._choice.final_norm,
            "normalize": False if self.normalize is None else self.normalize,
            **settings.seconds,
            "dtype": dtype,
            "fingerprint": self.fingerprint,
        }

    def hidden_states(self, samples: np.ndarray) -> np.ndarray:
        """Compute (T, D) float32 from (N,) samples at 16 kHz, without normalising them."""
        n_frames = (len(samples) - WINDOW) // HOP + 1
        values = np.empty((n_frames, self.dim), dtype=np.float32)
        chunks = self._options.chunks(n_frames, HOP)
        size = 1 if self._device.type == "cpu" else _GPU_BATCH
        before, after = self._encoder.reach
        # By default a GPU would round convolutions to TF32.
        with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            sound = torch.from_numpy(np.ascontiguousarray(samples)).to(self._device)
            window = self._front.windows(sound)
            for at in range(0, len(chunks), size):
                batch = chunks[at : at + size]
                inputs = [window(c.start - before, c.stop + after) for c, _ in batch]
                states = self._encoder.states(torch.stack(inputs))
                for (chunk, keep), picked in zip(batch, self._choice.pick(self._encoder, states)):
                    part = picked[keep.start - chunk.start : keep.stop - chunk.start]
                    values[keep] = part.cpu().numpy()
        return values


class FrontEnd:
    """Seven convolutions, a normalisation and a projection to the encoder's width.

    Frame t depends on samples [320t, 320t + 400), with one exception: Base normalises each
    channel of its first convolution over the whole sound. That convolution is linear, so mean
    and variance of its output follow from the first and second moments of its 10 input samples,
    and the normalisation is folded into its weights (`for_sound`). Processing a sound in blocks
    then gives the same result as processing it at once.

    Activations are (frames, channels), so that a convolution is one or two matrix products on
    views of its input.

    Args:
        shape: sizes of the network.
        tensors: float32 tensors under transformers' names.
        dtype: type of the convolutions after the first, and of the projection.
    """

    def __init__(
        self, shape: Architecture, tensors: dict[str, torch.Tensor], dtype: torch.dtype
    ) -> None:
        self._shape, self._dtype = shape, dtype
        self._convs: list[tuple[torch.Tensor, torch.Tensor | None]] = []
        self._norms: dict[int, tuple[torch.Tensor, torch.Tensor]] = {}
        for i in range(len(KERNELS)):
            conv = f"feature_extractor.conv_layers.{i}."
            weight, bias = tensors[f"{conv}conv.weight"], tensors.get(f"{conv}conv.bias")
            # (out, in, kernel) to (kernel · in, out).
            weight = weight.permute(2, 1, 0).reshape(-1, weight.shape[0])
            kind = dtype if i else torch.float32
            self._convs.append((weight.to(kind), None if bias is None else bias.to(kind)))
            if f"{conv}layer_norm.weight" in tensors:
                norm = (tensors[f"{conv}layer_norm.weight"], tensors[f"{conv}layer_norm.bias"])
                self._norms[i] = norm
        name = "feature_projection."
        self._norm = tensors[f"{name}layer_norm.weight"], tensors[f"{name}layer_norm.bias"]
        weight, bias = tensors[f"{name}projection.weight"], tensors[f"{name}projection.bias"]
        self._projection = weight.to(dtype), bias.to(dtype)

    def for_sound(self, samples: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the first convolution's weight (10, C) and bias (C,) for a sound (N,) float32."""
        weight, bias = self._convs[0]
        if self._shape.front_norm == "layer":
            return weight, bias
        kernel, stride = KERNELS[0], STRIDES[0]
        count = (len(samples) - kernel) // stride + 1
        first = torch.zeros(kernel, dtype=torch.float64, device=samples.device)
        second = torch.zeros(kernel, kernel, dtype=torch.float64, device=samples.device)
        for at in range(0, count, _MOMENT_FRAMES):
            n = min(_MOMENT_FRAMES, count - at)
            part = samples[at * stride : (at + n - 1) * stride + kernel].double()
            inputs = part.unfold(0, kernel, stride)
            first += inputs.sum(0)
            second += inputs.T @ inputs
        mean = first / count
        covariance = second / count - torch.outer(mean, mean)
        exact = weight.double()
        variance = ((covariance @ exact) * exact).sum(0).clamp_min(0.0)
        gain, shift = (part.double() for part in self._norms[0])
        scale = gain / torch.sqrt(variance + _NORM_EPS)
        # The convolution's own bias cancels with the mean.
        return (exact * scale).float(), (shift - scale * (mean @ exact)).float()

    def windows(self, samples: torch.Tensor) -> Callable[[int, int], torch.Tensor]:
        """Return a function of the projected frames [start, stop) of a sound, zeros outside it.

        It computes each frame once, for windows that move forwards: neither `start` nor `stop` may
        be less than in the previous call.

        Args:
            samples: (N,) float32 at 16 kHz, normalised as the network expects.
        """
        first, count = self.for_sound(samples), (len(samples) - WINDOW) // HOP + 1
        held, begin = self.frames(samples, 0, 0, first), 0

        def window(start: int, stop: int) -> torch.Tensor:
            nonlocal held, begin
            low, high = max(0, start), min(count, stop)
            new = self.frames(samples, max(low, begin + len(held)), high, first)
            held, begin = torch.cat([held[low - begin :], new]), low
            return F.pad(held, (0, 0, low - start, stop - high))

        return window

    def frames(
        self,
        samples: torch.Tensor,
        start: int,
        stop: int,
        first: tuple[torch.Tensor, torch.Tensor | None],
    ) -> torch.Tensor:
        """Compute projected frames [start, stop) of a sound: (stop - start, width) float32.

        Args:
            samples: (N,) float32, the whole sound.
            start, stop: range of frames.
            first: result of `for_sound` for this sound.
        """
        out = torch.empty(stop - start, self._shape.width, device=samples.device)
        for at in range(start, stop, _BLOCK_FRAMES):
            end = min(stop, at + _BLOCK_FRAMES)
            inputs = samples[at * HOP : (end - 1) * HOP + WINDOW]
            out[at - start : end - start] = self._project(self._convolve(inputs, first))
        return out

    def _convolve(
        self, samples: torch.Tensor, first: tuple[torch.Tensor, torch.Tensor | None]
    ) -> torch.Tensor:
        x = samples[:, None]
        for i, (kernel, stride) in enumerate(zip(KERNELS, STRIDES)):
            weight, bias = self._convs[i] if i else first
            x = _conv(x, weight, bias, kernel, stride)
            if self._shape.front_norm == "layer":
                x = F.layer_norm(x.float(), x.shape[1:], *self._norms[i], _NORM_EPS)
            x = F.gelu(x.to(self._dtype))
        return x

    def _project(self, x: torch.Tensor) -> torch.Tensor:
        x = F.layer_norm(x.float(), x.shape[1:], *self._norm, self._shape.eps)
        return F.linear(x.to(self._dtype), *self._projection).float()


def _conv(
    x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None, kernel: int, stride: int
) -> torch.Tensor:
    """Convolve (T, C) with (kernel · C, D) along the frames: ((T - kernel)//stride + 1, D).

    `stride` consecutive frames are a view, so a kernel of up to two strides takes two products
    without a copy. The first convolution has one channel, for which copying is faster.
    """
    channels = x.shape[1]
    count = (len(x) - kernel) // stride + 1
    if channels == 1 or not stride <= kernel <= 2 * stride:
        inputs = x.unfold(0, kernel, stride).transpose(1, 2).reshape(count, kernel * channels)
        return inputs @ weight if bias is None else torch.addmm(bias, inputs, weight)
    split, rest = stride * channels, (kernel - stride) * channels
    near = x[: count * stride].view(count, split)
    out = near @ weight[:split] if bias is None else torch.addmm(bias, near, weight[:split])
    if rest:
        far = x.as_strided((count, rest), (split, 1), x.storage_offset() + split)
        out.addmm_(far, weight[split:])
    return out


_CPU_SCORES = 3 << 19
_GPU_SCORES = 1 << 28
"""Number of attention scores held in memory at a time."""
_FEED_FORWARD_FRAMES = 2048


class Encoder:
    """Positional convolution and transformer layers with gated relative position bias.

    The bias depends only on key - query. It is stored as (heads, 2T - 1) and read through a
    view that shifts by one from query to query. Scores are computed for a block of queries at a
    time, never as (heads, T, T).

    Args:
        shape: sizes of the network.
        tensors: float32 tensors under transformers' names.
        depth: number of layers; those above are not loaded.
        dtype: type of all matrix products except queries with keys. Scores, softmax,
            normalisations, the positional convolution and the residual stream are always float32.
    """

    def __init__(
        self, shape: Architecture, tensors: dict[str, torch.Tensor], depth: int, dtype: torch.dtype
    ) -> None:
        self._shape, self._dtype = shape, dtype
        conv = "encoder.pos_conv_embed.conv."
        magnitude = tensors[f"{conv}parametrizations.weight.original0"]
        direction = tensors[f"{conv}parametrizations.weight.original1"]
        norm = torch.linalg.vector_norm(direction, dim=(0, 1), keepdim=True)
        self._position = direction * (magnitude / norm), tensors[f"{conv}bias"]
        self._norm = tensors["encoder.layer_norm.weight"], tensors["encoder.layer_norm.bias"]
        self._embedding = tensors["encoder.layers.0.attention.rel_attn_embed.weight"]
        self._layers = [self._layer(tensors, f"encoder.layers.{i}.") for i in range(depth)]
        # Frames before and after each frame that the positional convolution covers.
        before = shape.position_kernel // 2
        self.reach = before, shape.position_kernel - 1 - before
        # Large's output is its last state after normalisation.
        self.ends_in_norm = shape.pre_norm

    def states(self, x: torch.Tensor) -> Iterator[torch.Tensor]:
        """Yield hidden states 0 (input of the first layer) to `depth`, each (B, T, width).

        Args:
            x: (B, before + T + after, width) projected frames, with `reach` frames of context,
                zeros beyond the start and the end of the sound.
        """
        before, after = self.reach
        x = x[:, before : x.shape[1] - after] + self._positions(x)
        if not self._shape.pre_norm:
            x = self.final_norm(x)
        bias = self._bias(x.shape[1])
        yield x
        for layer in self._layers:
            x = self._apply(layer, x, bias)
            yield x

    def final_norm(self, x: torch.Tensor) -> torch.Tensor:
        """Normalise states (B, T, width): the last step of Large, the first of Base."""
        return self._normalised(x, self._norm)

    def _positions(self, x: torch.Tensor) -> torch.Tensor:
        # Not in bfloat16: oneDNN's convolution of few channels a group is wrong on CPUs with AMX.
        x = F.conv1d(x.transpose(1, 2), *self._position, groups=self._shape.position_groups)
        return F.gelu(x).transpose(1, 2)

    def _layer(self, tensors: dict[str, torch.Tensor], name: str) -> dict[str, tuple]:
        def pair(part: str) -> tuple[torch.Tensor, torch.Tensor]:
            return tensors[f"{name}{part}.weight"], tensors[f"{name}{part}.bias"]

        def linear(part: str) -> tuple[torch.Tensor, torch.Tensor]:
            weight, bias = pair(part)
            return weight.to(self._dtype), bias.to(self._dtype)

        scale = (self._shape.width // self._shape.heads) ** -0.5
        parts = [pair(f"attention.{part}_proj") for part in "qkv"]
        parts[0] = parts[0][0] * scale, parts[0][1] * scale
        weight, bias = (torch.cat([part[i] for part in parts]).to(self._dtype) for i in (0, 1))
        # The gate's eight outputs are only used as sums over two groups of four.
        gate = tuple(
            tensor.view(2, 4, *tensor.shape[1:]).sum(1)
            for tensor in pair("attention.gru_rel_pos_linear")
        )
        return {
            "qkv": (weight, bias),
            "out": linear("attention.out_proj"),
            "gate": (*gate, tensors[f"{name}attention.gru_rel_pos_const"].view(-1)),
            "attention_norm": pair("layer_norm"),
            "inner": linear("feed_forward.intermediate_dense"),
            "outer": linear("feed_forward.output_dense"),
            "output_norm": pair("final_layer_norm"),
        }

    def _apply(self, layer: dict[str, tuple], x: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        if self._shape.pre_norm:
            x = x + self._attention(layer, self._normalised(x, layer["attention_norm"]), bias)
            return x + self._feed_forward(layer, self._normalised(x, layer["output_norm"]))
        x = self._normalised(x + self._attention(layer, x, bias), layer["attention_norm"])
        return self._normalised(x + self._feed_forward(layer, x), layer["output_norm"])

    def _normalised(self, x: torch.Tensor, norm: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        return F.layer_norm(x, x.shape[-1:], *norm, self._shape.eps)

    def _feed_forward(self, layer: dict[str, tuple], x: torch.Tensor) -> torch.Tensor:
        def forward(part: torch.Tensor) -> torch.Tensor:
            inner = F.gelu(F.linear(part.to(self._dtype), *layer["inner"]))
            return F.linear(inner, *layer["outer"])

        parts = [forward(part) for part in x.split(_FEED_FORWARD_FRAMES, dim=1)]
        return parts[0] if len(parts) == 1 else torch.cat(parts, dim=1)

    def _attention(
        self, layer: dict[str, tuple], x: torch.Tensor, bias: torch.Tensor
    ) -> torch.Tensor:
        batch, frames, width = x.shape
        heads = self._shape.heads
        weight, shift, constant = layer["gate"]
        gates = torch.sigmoid(F.linear(x.view(batch, frames, heads, -1), weight, shift))
        gates = gates[..., 0] * (gates[..., 1] * constant - 1.0) + 2.0
        gates = gates.transpose(1, 2).contiguous()
        qkv = F.linear(x.to(self._dtype), *layer["qkv"])
        q, k, v = qkv.view(batch, frames, 3, heads, -1).permute(2, 0, 3, 1, 4)
        # Reversing the keys in time avoids a negative stride in the view of the bias.
        q, k, v = q.contiguous().float(), k.flip(2).float().transpose(2, 3), v.flip(2)
        out = v.new_empty(batch, frames, heads, width // heads)
        for item in range(batch):
            attended = _attend(q[item], k[item], v[item], gates[item], bias)
            out[item] = attended.transpose(0, 1)
        return F.linear(out.view(x.shape), *layer["out"])

    def _bias(self, frames: int) -> torch.Tensor:
        """Return (heads, 2T - 1): entry i + j is for query i and the j-th key from the end."""
        distance = torch.arange(frames - 1, -frames, -1, device=self._embedding.device)
        return self._embedding[self._bucket(distance)].T.contiguous()

    def _bucket(self, distance: torch.Tensor) -> torch.Tensor:
        """Return T5 buckets of key - query: exact near zero, then logarithmic; half per sign."""
        half = self._shape.buckets // 2
        exact = half // 2
        far = distance.abs()
        # Float32 operations in transformers' order: rounding can change a bucket.
        position = torch.log(far.float() / exact) / math.log(self._shape.max_distance / exact)
        large = (exact + position * (half - exact)).clamp(max=half - 1)
        return torch.where(far < exact, far, large.long()) + half * (distance > 0)


def _attend(
    q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, gates: torch.Tensor, bias: torch.Tensor
) -> torch.Tensor:
    """Compute attention (H, T, D) with gated relative bias, a block of scores at a time.

    Written out instead of calling scaled_dot_product_attention, which on a CPU takes 1.5 times as
    long because each block needs a materialised mask. q (H, T, D) is scaled; k (H, D, T) and v (H,
    T, D), whose dtype is that of the product with them, are reversed in time. `gates` are (H, T),
    `bias` (H, 2T - 1).
    """
    heads, frames, _ = q.shape
    held = _CPU_SCORES if q.device.type == "cpu" else _GPU_SCORES
    rows = min(frames, max(1, held // frames))
    # On a CPU one matrix product per head is faster than a batched one.
    group = 1 if q.device.type == "cpu" else min(heads, max(1, held // (rows * frames)))
    # One buffer for all blocks: allocating this much memory costs more than the computation.
    buffer = q.new_empty(group * rows * frames)
    narrow = buffer if v.dtype == q.dtype else v.new_empty(len(buffer))
    out = torch.empty_like(v)
    for head in range(0, heads, group):
        some = slice(head, min(heads, head + group)) if group > 1 else head
        table = bias[some]
        for first in range(0, frames, rows):
            block = slice(first, min(frames, first + rows))
            shape = (*table.shape[:-1], block.stop - first, frames)
            scores = buffer[: math.prod(shape)].view(shape)
            slide = table.as_strided(shape, (*table.stride(), 1), table.storage_offset() + first)
            torch.mul(slide, gates[some, block, None], out=scores)
            multiply_add = scores.addmm_ if scores.dim() == 2 else scores.baddbmm_
            multiply_add(q[some, block], k[some])
            torch.softmax(scores, -1, out=scores)
            weights = narrow[: math.prod(shape)].view(shape)
            if weights.dtype != scores.dtype:
                weights.copy_(scores)
            torch.matmul(weights, v[some], out=out[some, block])
    return out
