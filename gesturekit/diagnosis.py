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

from audio_features.errors import AudioFeaturesError
from gesturekit.errors import ConfigError, FormatError

_LOW_DISK = 2 * 10**9
_NEEDED = ("numpy", "scipy", "soundfile", "soxr", "librosa", "safetensors", "yaml", "matplotlib")
Result = str | tuple[str, str]
"""Text of a finding; with advice where an optional component is missing or slow."""


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
    checks: dict[str, Callable[[], Result]] = {
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
            found = check()
            text, advice = (found, "") if isinstance(found, str) else found
            yield Finding(name, "note" if advice else "ok", text, advice)
        except (ConfigError, AudioFeaturesError) as error:
            yield Finding(name, "broken", _line(error))  # the message says what to do
        except Exception as error:  # a broken installation may raise anything
            yield Finding(name, "broken", _line(error), "install it again: make setup")


def _program() -> Result:
    text = f"{metadata.version('gesturekit')}, Python {platform.python_version()}"
    return f"{text}, {platform.platform(terse=True)}"


def _torch() -> Result:
    import torch

    build = f"built for CUDA {torch.version.cuda}" if torch.version.cuda else "built for the CPU"
    return f"{torch.__version__}, {build}"


def _gpu() -> Result:
    import torch

    if torch.cuda.is_available():
        gpus = [torch.cuda.get_device_properties(k) for k in range(torch.cuda.device_count())]
        return ", ".join(f"{gpu.name} ({gpu.total_memory / 1e9:.0f} GB)" for gpu in gpus)
    if torch.version.cuda:
        advice = "if there is one, look at nvidia-smi: the driver must be as new as the CUDA build"
        return "torch is built for CUDA but sees no GPU", advice
    if shutil.which("nvidia-smi"):
        advice = "to use it: pip install torch from pytorch.org's CUDA index"
        return "there may be one, but torch is built for the CPU", advice
    return "none; everything runs on the CPU"


def _threads() -> Result:
    import torch

    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    threads = torch.get_num_threads()
    advice, asked = "", os.environ.get("OMP_NUM_THREADS")
    if threads > cores:
        advice = f"set OMP_NUM_THREADS={cores}: more is slower"
    elif threads < cores and asked:
        advice = f"OMP_NUM_THREADS={asked} says so"
    return f"torch uses {threads} of {cores} cores", advice


def _libraries() -> Result:
    broken = []
    for name in _NEEDED:
        try:
            __import__(name)
        except Exception as error:
            broken.append(f"{name} ({_line(error)})")
    if broken:
        raise ConfigError(f"{'; '.join(broken)}: pip install -e . again")
    import soundfile

    return f"all import; libsndfile {soundfile.__libsndfile_version__} reads the sound"


def _torchaudio() -> Result:
    if util.find_spec("torchaudio") is None:
        return "not installed, and not needed"
    version = metadata.version("torchaudio")
    try:
        __import__("torchaudio")
    except (ImportError, OSError) as error:
        return f"{version} does not import, built for another torch: {_line(error)}", (
            "nothing of gesturekit needs it, but transformers fails while it is there: "
            "pip uninstall torchaudio, or install the build that matches torch"
        )
    return f"{version}, not needed"


def _transformers() -> Result:
    if util.find_spec("transformers") is None:
        return "not installed", "pip install 'gesturekit[encoders]'"
    version = metadata.version("transformers")
    try:
        from transformers import WavLMModel  # noqa: F401
    except Exception as error:
        text = f"{version}, but its WavLM does not import: {_line(error)}"
        return text, "ours reads WavLM weights without it; see torchaudio above"
    return version


def _ffmpeg() -> Result:
    """Check imageio-ffmpeg, which brings its own ffmpeg or finds the system's."""
    try:
        import imageio_ffmpeg

        return str(imageio_ffmpeg.get_ffmpeg_exe())
    except (ImportError, RuntimeError):
        text = "imageio-ffmpeg is not installed; only mp4 files need it"
        return text, "pip install 'gesturekit[video]'"


def _blender() -> Result:
    from gesturekit.formats.fbx import PROGRAM, blender_command

    advice = f"install Blender or its module bpy, or name it: {PROGRAM}=/path/to/blender"
    try:
        program = blender_command(Path())[0]
    except FormatError:
        return "not found; only FBX files need it", advice
    if shutil.which(program) is None:
        return f"{program}: no such program", advice
    return f"{program}, for FBX files"


def _player() -> Result:
    bundle = Path(__file__).parent / "viewer" / "player.bundle.js"
    if not bundle.is_file():
        raise ConfigError("its bundle is missing: make setup")
    return f"bundled, {bundle.stat().st_size / 1e6:.1f} MB"


def _demo() -> Result:
    from gesturekit.systems import load

    motion = load("demo").generate(seconds=1.0)
    return f"makes motion: {motion.n_frames} frames for a second"


def _disk() -> Result:
    free = shutil.disk_usage(Path.cwd()).free
    advice = "make room: runs, caches and videos are big" if free < _LOW_DISK else ""
    return f"{free / 1e9:.1f} GB free in {Path.cwd()}", advice


def _cache() -> Result:
    from audio_features.cache import cache_from_environment

    cache = cache_from_environment()
    contents = cache.contents()
    text = f"{cache.folder}: {contents.entries} entries, {contents.size / 1e9:.3f} GB"
    there = cache.folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        advice = "name another folder with GESTUREKIT_CACHE; until then features are made anew"
        return f"{text}; cannot be written to", advice
    if shutil.disk_usage(there).free < _LOW_DISK:
        return f"{text}; its disk is nearly full", "gesturekit cache clear"
    return text


def _weights(weights: str | os.PathLike[str] | None) -> Result:
    if weights is not None:
        from audio_features.huggingface.weights import is_encoder_folder, read_encoder
        from audio_features.wavlm.weights import read_weights

        if is_encoder_folder(weights):
            return f"Hugging Face encoder: {read_encoder(weights)[0].describe()}"
        return str(read_weights(weights)[0].describe())
    if places := list(_usual_places()):
        return f"weights in {', '.join(map(str, places))}"
    return "no weights in the usual places; light features need none", (
        "download microsoft/wavlm-base-plus or wavlm-large from huggingface.co, and name the "
        "folder with --weights"
    )


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
