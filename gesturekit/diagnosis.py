"""Diagnosis of the installation: usable components, broken ones, and remedies."""

from __future__ import annotations

import os
import platform
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import metadata, util
from pathlib import Path
from typing import Literal

from gesturekit.errors import ConfigError, FormatError

_LOW_DISK = 2 * 10**9
_NEEDED = ("numpy", "scipy", "soundfile", "soxr", "librosa", "safetensors", "yaml", "matplotlib")


@dataclass(frozen=True)
class Finding:
    """Result of one check.

    Attributes:
        name: the component.
        state: "ok"; "note" for an optional component that is missing or slow; "broken" for a
            required one that does not work.
        text: the finding.
        advice: the remedy, or "".
    """

    name: str
    state: Literal["ok", "note", "broken"]
    text: str
    advice: str = ""


def diagnose(weights: str | os.PathLike[str] | None = None) -> Iterator[Finding]:
    """Run all checks, one after the other; errors become findings.

    Args:
        weights: WavLM weights or a Hugging Face speech encoder to read; by default the WavLM
            weights in the usual folders are listed.
    """
    checks: dict[str, Callable[[], Finding]] = {
        "gesturekit": _program,
        "torch": _torch,
        "GPU": _gpu,
        "threads": _threads,
        "libraries": _libraries,
        "torchaudio": _torchaudio,
        "transformers": _transformers,
        "ffmpeg": _ffmpeg,
        "Blender": _blender,
        "HTML player": _player,
        "demo model": _demo,
        "disk": _disk,
        "cache": _cache,
        "WavLM": lambda: _weights(weights),
    }
    for name, check in checks.items():
        try:
            yield check()
        except ConfigError as error:
            yield Finding(name, "broken", _line(error))  # the message says what to do
        except Exception as error:  # a broken installation may raise anything
            yield Finding(name, "broken", _line(error), "install it again: make setup")


def _program() -> Finding:
    text = f"{metadata.version('gesturekit')}, Python {platform.python_version()}"
    return Finding("gesturekit", "ok", f"{text}, {platform.platform(terse=True)}")


def _torch() -> Finding:
    import torch

    build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for the CPU"
    return Finding("torch", "ok", f"{torch.__version__}, {build}")


def _gpu() -> Finding:
    import torch

    if torch.cuda.is_available():
        gpus = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
        names = ", ".join(f"{gpu.name} ({gpu.total_memory / 1e9:.0f} GB)" for gpu in gpus)
        return Finding("GPU", "ok", names)
    if torch.version.cuda:
        advice = "if there is one, look at nvidia-smi: the driver must be as new as the CUDA build"
        return Finding("GPU", "note", "torch is built for CUDA but sees no GPU", advice)
    if shutil.which("nvidia-smi"):
        advice = "to use it: pip install torch from pytorch.org's CUDA index"
        return Finding("GPU", "note", "there may be one, but torch is built for the CPU", advice)
    return Finding("GPU", "ok", "none; everything runs on the CPU")


def _threads() -> Finding:
    import torch

    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    threads = torch.get_num_threads()
    text = f"torch uses {threads} of {cores} cores"
    if threads > cores:
        return Finding("threads", "note", text, f"set OMP_NUM_THREADS={cores}: more is slower")
    if threads < cores and os.environ.get("OMP_NUM_THREADS"):
        advice = f"OMP_NUM_THREADS={os.environ['OMP_NUM_THREADS']} says so"
        return Finding("threads", "note", text, advice)
    return Finding("threads", "ok", text)


def _libraries() -> Finding:
    broken = []
    for name in _NEEDED:
        try:
            __import__(name)
        except Exception as error:
            broken.append(f"{name} ({_line(error)})")
    if broken:
        return Finding("libraries", "broken", "; ".join(broken), "pip install -e . again")
    import soundfile

    text = f"all import; libsndfile {soundfile.__libsndfile_version__} reads the sound"
    return Finding("libraries", "ok", text)


def _torchaudio() -> Finding:
    if util.find_spec("torchaudio") is None:
        return Finding("torchaudio", "ok", "not installed, and not needed")
    version = metadata.version("torchaudio")
    try:
        __import__("torchaudio")
        return Finding("torchaudio", "ok", f"{version}, not needed")
    except (ImportError, OSError) as error:
        text = f"{version} does not import, built for another torch: {_line(error)}"
    advice = (
        "nothing of gesturekit needs it, but transformers fails while it is there: "
        "pip uninstall torchaudio, or install the build that matches torch"
    )
    return Finding("torchaudio", "note", text, advice)


def _transformers() -> Finding:
    if util.find_spec("transformers") is None:
        return Finding(
            "transformers", "note", "not installed", "pip install 'gesturekit[encoders]'"
        )
    version = metadata.version("transformers")
    try:
        from transformers import WavLMModel  # noqa: F401
    except Exception as error:
        text = f"{version}, but its WavLM does not import: {_line(error)}"
        advice = "ours reads WavLM weights without it; see torchaudio above"
        return Finding("transformers", "note", text, advice)
    return Finding("transformers", "ok", version)


def _ffmpeg() -> Finding:
    """Check imageio-ffmpeg, which brings its own ffmpeg or finds the system's."""
    try:
        import imageio_ffmpeg

        return Finding("ffmpeg", "ok", imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        text = "imageio-ffmpeg is not installed; only mp4 files need it"
        return Finding("ffmpeg", "note", text, "pip install 'gesturekit[video]'")


def _blender() -> Finding:
    from gesturekit.formats.fbx import PROGRAM, blender_command

    advice = f"install Blender or its module bpy, or name it: {PROGRAM}=/path/to/blender"
    try:
        program = blender_command(Path())[0]
    except FormatError:
        return Finding("Blender", "note", "not found; only FBX files need it", advice)
    if shutil.which(program) is None:
        return Finding("Blender", "note", f"{program}: no such program", advice)
    return Finding("Blender", "ok", f"{program}, for FBX files")


def _player() -> Finding:
    bundle = Path(__file__).parent / "viewer" / "player.bundle.js"
    if bundle.is_file():
        return Finding("HTML player", "ok", f"bundled, {bundle.stat().st_size / 1e6:.1f} MB")
    return Finding("HTML player", "broken", "its bundle is missing", "make setup")


def _demo() -> Finding:
    from gesturekit.systems import load

    motion = load("demo").generate(seconds=1.0)
    return Finding("demo model", "ok", f"makes motion: {motion.n_frames} frames for a second")


def _disk() -> Finding:
    free = shutil.disk_usage(Path.cwd()).free
    text = f"{free / 1e9:.1f} GB free in {Path.cwd()}"
    if free < _LOW_DISK:
        return Finding("disk", "note", text, "make room: runs, caches and videos are big")
    return Finding("disk", "ok", text)


def _cache() -> Finding:
    from audio_features.cache import cache_from_environment

    cache = cache_from_environment()
    contents = cache.contents()
    text = f"{cache.folder}: {contents.entries} entries, {contents.size / 1e9:.3f} GB"
    there = cache.folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        advice = "name another folder with GESTUREKIT_CACHE; until then features are made anew"
        return Finding("cache", "note", f"{text}; cannot be written to", advice)
    if shutil.disk_usage(there).free < _LOW_DISK:
        return Finding(
            "cache", "note", f"{text}; its disk is nearly full", "gesturekit cache clear"
        )
    return Finding("cache", "ok", text)


def _weights(weights: str | os.PathLike[str] | None) -> Finding:
    from audio_features.errors import AudioFeaturesError

    if weights is not None:
        from audio_features.huggingface.weights import is_encoder_folder, read_encoder
        from audio_features.wavlm.weights import read_weights

        try:
            if is_encoder_folder(weights):
                return Finding("encoder", "ok", read_encoder(weights)[0].describe())
            return Finding("WavLM", "ok", read_weights(weights)[0].describe())
        except AudioFeaturesError as error:
            return Finding("WavLM", "broken", str(error))
    places = list(_usual_places())
    if not places:
        return Finding(
            "WavLM",
            "note",
            "no weights in the usual places; light features need none",
            "download microsoft/wavlm-base-plus or wavlm-large from huggingface.co, and name "
            "the folder with --weights",
        )
    return Finding("WavLM", "ok", f"weights in {', '.join(map(str, places))}")


def _usual_places() -> Iterator[Path]:
    """Yield WavLM weights in the download folders of Hugging Face and torch."""
    home = Path.home() / ".cache"
    of_home = Path(os.environ.get("HF_HOME", home / "huggingface")) / "hub"
    hub = Path(os.environ.get("HF_HUB_CACHE") or of_home)
    for folder in sorted(hub.glob("models--*wavlm*/snapshots/*")):
        if any((folder / name).exists() for name in ("model.safetensors", "pytorch_model.bin")):
            yield folder
    torch_home = Path(os.environ.get("TORCH_HOME", home / "torch"))
    yield from sorted((torch_home / "hub" / "checkpoints").glob("*wavlm*.p*"))
    yield from sorted(Path.cwd().glob("WavLM-*.pt"))


def _line(error: BaseException) -> str:
    text = str(error) or type(error).__name__
    return " ".join(text.splitlines()[0].split())[:300]


def is_usable(findings: list[Finding]) -> bool:
    """Return True if no required component is broken."""
    return all(finding.state != "broken" for finding in findings)
