"""WavLM's front end: samples to projected frames, in blocks of any size with equal results."""

from __future__ import annotations

import torch
from torch.nn import functional as F

from audio_features.wavlm.architecture import HOP, WINDOW, Architecture

_BLOCK_FRAMES = 128
_MOMENT_FRAMES = 1 << 16
_NORM_EPS = 1e-5  # of the normalisations in the front end, in all three code bases


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
        for i in range(len(shape.kernels)):
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
        self._projection = (
            tensors[f"{name}projection.weight"].to(dtype),
            tensors[f"{name}projection.bias"].to(dtype),
        )

    def for_sound(self, samples: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Return the first convolution's weight (10, C) and bias (C,) for a sound (N,) float32."""
        weight, bias = self._convs[0]
        if self._shape.front_norm == "layer":
            return weight, bias
        kernel, stride = self._shape.kernels[0], self._shape.strides[0]
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

    def sound(self, samples: torch.Tensor) -> SoundFrames:
        """Prepare a sound: (N,) float32 at 16 kHz, normalised as the network expects."""
        return SoundFrames(self, samples)

    def frames(
        self,
        samples: torch.Tensor,
        start: int,
        stop: int,
        first: tuple[torch.Tensor, torch.Tensor | None],
        block: int = _BLOCK_FRAMES,
    ) -> torch.Tensor:
        """Compute projected frames [start, stop) of a sound: (stop - start, width) float32.

        Args:
            samples: (N,) float32, the whole sound.
            start, stop: range of frames.
            first: result of `for_sound` for this sound.
            block: number of frames processed at a time.
        """
        out = torch.empty(stop - start, self._shape.width, device=samples.device)
        for at in range(start, stop, block):
            end = min(stop, at + block)
            inputs = samples[at * HOP : (end - 1) * HOP + WINDOW]
            out[at - start : end - start] = self._project(self._convolve(inputs, first))
        return out

    def _convolve(
        self, samples: torch.Tensor, first: tuple[torch.Tensor, torch.Tensor | None]
    ) -> torch.Tensor:
        x = samples[:, None]
        for i, (kernel, stride) in enumerate(zip(self._shape.kernels, self._shape.strides)):
            weight, bias = self._convs[i] if i else first
            x = _conv(x, weight, bias, kernel, stride)
            if self._shape.front_norm == "layer":
                x = F.layer_norm(x.float(), x.shape[1:], *self._norms[i], _NORM_EPS)
            x = F.gelu(x.to(self._dtype))
        return x

    def _project(self, x: torch.Tensor) -> torch.Tensor:
        x = F.layer_norm(x.float(), x.shape[1:], *self._norm, self._shape.eps)
        return F.linear(x.to(self._dtype), *self._projection).float()


class SoundFrames:
    """Projected frames of one sound, each computed once, for windows that move forwards.

    Args:
        front: the front end.
        samples: (N,) float32 at 16 kHz.
    """

    def __init__(self, front: FrontEnd, samples: torch.Tensor) -> None:
        self._front, self._samples = front, samples
        self._first = front.for_sound(samples)
        self._count = (len(samples) - WINDOW) // HOP + 1
        self._start = 0
        self._held = front.frames(samples, 0, 0, self._first)

    def window(self, start: int, stop: int) -> torch.Tensor:
        """Return frames [start, stop): (stop - start, width), zeros outside the sound.

        Neither `start` nor `stop` may be less than in the previous call.
        """
        low, high = max(0, start), min(self._count, stop)
        new = self._front.frames(
            self._samples, max(low, self._start + len(self._held)), high, self._first
        )
        self._held, self._start = torch.cat([self._held[low - self._start :], new]), low
        return F.pad(self._held, (0, 0, low - start, stop - high))


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
