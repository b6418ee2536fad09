"""WavLM Base+ compared with transformers: time, memory, and the accuracy of chunks.

The weights are random (none can be shipped) and of the published size: speed, memory and exactness
are those of real weights. The difference between chunks and full context is not, so it is given for
two kinds of random weights: as initialised, with attention spread over the whole sound, and "peaky"
ones with sharp attention to near frames.

Threads are torch's. Peak memory is of whole child processes, including imports and weights.

`--device cuda` measures Base+ and Large on a GPU instead, both sides in the same precision, without
TF32: clips of 10 s, and ten minutes, which ours cuts into chunks with context and transformers gets
in pieces of 30 s. Transformers gets clips and pieces one by one, and in batches of one length.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
import transformers
from harness import arguments, gpu_peak, report, timed
from transformers.utils import logging

import audio_features as af
from gesturekit.systems import bundled_speech

CPU = Path("/proc/cpuinfo")
CHUNKS = {"full_context": 0.0, "chunk": 20.0, "context": 2.0}

_PEAK = """
import re, sys
from pathlib import Path
import numpy as np
import torch
import audio_features as af
torch.set_num_threads({threads})
rng = np.random.default_rng(0)
wave = af.Wave(rng.standard_normal({seconds} * 16_000, dtype=np.float32) / 10, 16_000)
track = af.WavLM({weights!r}).extract(wave)
assert len(track.values) == ({seconds} * 16_000 - 400) // 320 + 1
print(re.search(r"VmHWM:\\s+(\\d+) kB", Path("/proc/self/status").read_text())[1])
"""


def main() -> None:
    options = arguments(__doc__.splitlines()[0], takes_device=True)
    logging.disable_progress_bar()
    torch.manual_seed(0)
    if options.device != "cpu":
        report(on_gpu(options.device, quick=options.quick), options.json)
        return
    torch.set_num_threads(min(2, torch.get_num_threads()))
    flags = CPU.read_text() if CPU.is_file() else ""
    has = "has" if "avx512_bf16" in flags or "amx_bf16" in flags else "is not known to have"
    print(f"This processor {has} bfloat16 arithmetic.")
    model = transformers.WavLMModel(transformers.WavLMConfig()).eval()
    with tempfile.TemporaryDirectory() as folder:
        model.save_pretrained(folder)
        figures = times(model, folder, quick=options.quick)
        report(figures, None)
        figures |= peaks(folder, quick=options.quick)
        figures |= differences(model, folder, quick=options.quick)
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


def speech(seconds: float) -> np.ndarray:
    """The bundled recording at 16 kHz, said again and again at changing loudness."""
    spoken = af.Wave.load(bundled_speech()).resample(16_000).samples
    n = round(seconds * 16_000)
    loudness = 0.7 + 0.3 * np.sin(np.arange(n) / 16_000)
    return (np.resize(spoken, n) * loudness).astype(np.float32)


def times(model, folder: str, *, quick: bool) -> dict[str, dict]:
    """Seconds of both for sounds of two lengths; all ways in turn, so a busy machine hits all."""
    ways = {
        "fp32": af.WavLM(folder),
        "bf16": af.WavLM(folder, dtype="bf16"),
        "fp32_chunks": af.WavLM(folder, **CHUNKS),
        "bf16_chunks": af.WavLM(folder, dtype="bf16", **CHUNKS),
    }
    in_chunks = "chunks of 20 s with 2 s context"
    notes = {
        "fp32": "exact",
        "bf16": "bfloat16, full context",
        "fp32_chunks": in_chunks,
        "bf16_chunks": f"bfloat16, {in_chunks}",
    }
    works: dict[str, Callable[[np.ndarray], np.ndarray]]
    works = {name: wavlm.hidden_states for name, wavlm in ways.items()}
    works["transformers"] = lambda samples: forward(model, samples)
    figures = {}
    lengths = ((10, 3, 1), (20, 1, 2)) if quick else ((10, 7, 1), (60, 3, 4))
    for seconds, runs, count in lengths:
        names = list(ways)[:count]
        some = {name: works[name] for name in (*names, "transformers")}
        spent, values = interleaved(some, speech(seconds), runs)
        for name in names:
            error = distance(values[name], values["transformers"])
            figures[f"wavlm_{seconds}s_{name}"] = {
                "ours": spent[name],
                "other": spent["transformers"],
                "ratio": spent["transformers"] / spent[name],
                "note": f"{seconds} s, Base+, {torch.get_num_threads()} threads, {notes[name]}; "
                f"relative L2 to transformers {error:.1e}",
            }
    return figures


def forward(model, samples: np.ndarray) -> np.ndarray:
    with torch.inference_mode():
        return model(torch.from_numpy(samples)[None]).last_hidden_state[0].numpy()


def interleaved(
    works: dict[str, Callable[[np.ndarray], np.ndarray]], samples: np.ndarray, runs: int
) -> tuple[dict[str, float], dict[str, np.ndarray]]:
    """Median seconds of each, after one run to warm up, and what they gave."""
    values = {name: work(samples) for name, work in works.items()}
    spent: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(runs):
        for name, work in works.items():
            start = time.perf_counter()
            work(samples)
            spent[name].append(time.perf_counter() - start)
    return {name: statistics.median(seconds) for name, seconds in spent.items()}, values


SIZES = {
    "base": {},
    "large": {
        "hidden_size": 1024,
        "num_hidden_layers": 24,
        "num_attention_heads": 16,
        "intermediate_size": 4096,
        "feat_extract_norm": "layer",
        "do_stable_layer_norm": True,
    },
}
BATCH = 8


def on_gpu(device: str, *, quick: bool) -> dict[str, dict]:
    """Seconds of both on a GPU, with hours of sound in an hour."""
    figures, runs = {}, 3 if quick else 7
    clips = [10.0] * (2 * BATCH if quick else 8 * BATCH)
    for size, config in SIZES.items():
        torch.manual_seed(0)
        model = transformers.WavLMModel(transformers.WavLMConfig(**config)).eval()
        with tempfile.TemporaryDirectory() as folder:
            model.save_pretrained(folder)
            for dtype, kind in (("fp32", torch.float32), ("bf16", torch.bfloat16)):
                wavlm = af.WavLM(folder, dtype=dtype, device=device)
                theirs = model.to(device, kind)
                for what, lengths, pieces in (
                    (f"{len(clips)} clips of 10 s", clips, clips),
                    ("10 minutes", [600.0], [30.0] * 20),
                ):
                    sound = speech(sum(lengths))
                    own, other = (cut(sound, parts) for parts in (lengths, pieces))
                    works = {
                        "ours": lambda own=own, w=wavlm: [w.hidden_states(part) for part in own],
                        "single": lambda other=other, m=theirs: batched(m, other, 1),
                        "batched": lambda other=other, m=theirs: batched(m, other, BATCH),
                    }
                    figures |= _beside(works, f"wavlm_{size}_{dtype}", what, len(sound), runs)
            del wavlm, theirs, works
    return figures


def _beside(
    works: dict[str, Callable[[], list[np.ndarray]]], name: str, what: str, n: int, runs: int
) -> dict[str, dict]:
    """Compare ours with both ways of transformers, in turn."""
    values = {way: np.concatenate(work()) for way, work in works.items()}
    is_same = len(values["ours"]) == len(values["single"])
    apart = f", relative L2 {distance(values['ours'], values['single']):.1e}" if is_same else ""
    spent: dict[str, list[float]] = {way: [] for way in works}
    for _ in range(runs):
        for way, work in works.items():
            spent[way] += timed(work, 1)
    median = {way: statistics.median(times) for way, times in spent.items()}
    hours = {way: n / 16_000 / seconds for way, seconds in median.items()}
    return {
        f"{name}_{what.replace(' ', '_')}_{way}": {
            "ours": median["ours"],
            "other": median[way],
            "ratio": median[way] / median["ours"],
            "note": f"{what}: {hours['ours']:.0f} hours an hour{gpu_peak(works['ours'])}; other: "
            f"transformers, {'batches of ' + str(BATCH) if way == 'batched' else 'one by one'}, "
            f"{hours[way]:.0f} hours an hour{gpu_peak(works[way])}{apart}",
        }
        for way in ("single", "batched")
    }


def cut(sound: np.ndarray, seconds: list[float]) -> list[np.ndarray]:
    """Cut a sound into parts of these lengths."""
    return np.split(sound, np.cumsum([round(s * 16_000) for s in seconds])[:-1])


def batched(model, sounds: list[np.ndarray], size: int) -> list[np.ndarray]:
    """Forward sounds of one length, some at a time."""
    weight, values = next(model.parameters()), []
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
        for at in range(0, len(sounds), size):
            inputs = torch.from_numpy(np.stack(sounds[at : at + size]))
            states = model(inputs.to(weight.device, weight.dtype)).last_hidden_state
            values += [*states.float().cpu().numpy()]
    return values


def distance(values: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm(values - truth) / np.linalg.norm(truth))


def peaks(folder: str, *, quick: bool) -> dict[str, dict]:
    """Highest resident memory in GB, with the default settings (full context to 300 s)."""
    figures = {}
    lengths = ((20, None),) if quick else ((60, None), (300, 2.0), (3600, 3.0))
    for seconds, limit in lengths:
        code = _PEAK.format(seconds=seconds, weights=folder, threads=torch.get_num_threads())
        start = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", code], check=True, capture_output=True, text=True
        )
        spent = time.perf_counter() - start
        peak = int(done.stdout) * 1024 / 1e9
        # What one of transformers' score buffers alone takes: (12, T, T) of 4 bytes.
        buffer = 12 * (seconds * 50) ** 2 * 4 / 1e9
        allowed = "" if limit is None else f", at most {limit:g} GB wanted"
        print(f"wavlm_peak_{seconds}s: {peak:.2f} GB{allowed}, {spent:.0f} s in all")
        figures[f"wavlm_peak_{seconds}s"] = {
            "ours": peak,
            "other": buffer,
            "ratio": buffer / peak,
            "note": "GB; other: one (12, T, T) buffer, of which transformers holds several",
        }
    return figures


def differences(model, folder: str, *, quick: bool) -> dict[str, dict]:
    """Relative L2 between chunked and full context, over chunk length and context."""
    seconds = 15 if quick else 90
    grid = ((5, 0), (10, 2))
    if not quick:
        grid += ((5, 1), (10, 0), (20, 2), (20, 5), (30, 5), (40, 5), (60, 16))
    samples = speech(seconds)
    figures = {}
    for kind in ("peaky",) if quick else ("as initialised", "peaky"):
        if kind == "peaky":
            make_peaky(model)
            model.save_pretrained(folder)
        whole = af.WavLM(folder).hidden_states(samples)
        for chunk, context in grid:
            wavlm = af.WavLM(folder, full_context=0.0, chunk=chunk, context=context)
            values = wavlm.hidden_states(samples)
            frames = np.linalg.norm(values - whole, axis=1) / np.linalg.norm(whole, axis=1)
            total, worst = distance(values, whole), float(np.quantile(frames, 0.95))
            print(
                f"chunks of {chunk} s, context {context} s, weights {kind}: "
                f"relative L2 {total:.3f}, 95 % of frames below {worst:.3f}"
            )
            figures[f"wavlm_difference_{chunk}s_{context}s_{kind.replace(' ', '_')}"] = {
                "ours": total,
                "other": worst,
                "ratio": math.nan if total == 0 else worst / total,
                "note": f"chunked to full context, {seconds} s; other: 95th percentile of frames",
            }
    return figures


def make_peaky(model) -> None:
    """Sharp attention, and a relative bias that falls with distance as far as it reaches."""
    with torch.no_grad():
        for layer in model.encoder.layers:
            layer.attention.q_proj.weight.mul_(3.0)
            layer.attention.k_proj.weight.mul_(3.0)
        table = model.encoder.layers[0].attention.rel_attn_embed.weight
        far = torch.arange(len(table)) % (len(table) // 2)
        table.copy_(-4.0 * far[:, None] / len(table) + 0.3 * torch.randn_like(table))


if __name__ == "__main__":
    main()
