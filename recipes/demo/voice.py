"""espeak-ng as a Python function: sentences in, samples out.

The library and its data come with the package `espeakng-loader` and are driven by ctypes,
after `speak_lib.h` of espeak-ng.
"""

from __future__ import annotations

import ctypes
import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from xml.sax.saxutils import escape

import numpy as np

# Constants of speak_lib.h.
_SYNCHRONOUS = 2
_DONT_EXIT = 0x8000
_RATE, _PITCH, _RANGE = 1, 3, 4
_POSITION_CHARACTER = 1
_UTF8, _SSML = 1, 0x10
_CALLBACK = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.c_void_p
)


@dataclass(frozen=True)
class Voice:
    """How to say something.

    name: espeak language and variant, such as `en-us+m3`; rate: words a minute;
    pitch: 0–99, 50 is the voice's own; pitch_range: 0 (monotone) to 99 (lively).
    """

    name: str
    rate: int = 165
    pitch: int = 50
    pitch_range: int = 50


def speak(sentences: list[str], voice: Voice | Sequence[Voice]) -> tuple[list[np.ndarray], int]:
    """Say each sentence; words between *asterisks* are stressed.

    voice: one for all sentences, or one for each; all of them have the same name.

    Returns one (N,) float32 array in [-1, 1] for each sentence, and their rate in Hz.
    Raises RuntimeError if the engine does not start or does not know the voice.

    The engine runs in a process of its own. The library's flutter and noise run on from call
    to call, even across its own restart; a new process makes the samples depend on the
    sentences and the voice alone.
    """
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as process:
        voices = [voice] * len(sentences) if isinstance(voice, Voice) else list(voice)
        return process.submit(_speak_here, sentences, voices).result()


def _speak_here(sentences: list[str], voices: list[Voice]) -> tuple[list[np.ndarray], int]:
    try:
        import espeakng_loader
    except ImportError as error:
        raise RuntimeError(
            "the demo corpus needs espeak-ng: pip install espeakng-loader"
        ) from error
    library = ctypes.CDLL(espeakng_loader.get_library_path())
    data = espeakng_loader.get_data_path()
    blocks: list[np.ndarray] = []

    def collect(samples, count: int, _events) -> int:
        if samples and count > 0:
            blocks.append(np.ctypeslib.as_array(samples, (count,)).copy())
        return 0

    callback = _CALLBACK(collect)  # a name of its own: the library does not keep it alive
    rate = library.espeak_Initialize(_SYNCHRONOUS, 0, data.encode(), _DONT_EXIT)
    if rate <= 0:
        raise RuntimeError(f"espeak-ng did not start with the data in {data}")
    library.espeak_SetSynthCallback(callback)
    name = voices[0].name
    if library.espeak_SetVoiceByName(name.encode()) != 0:
        raise RuntimeError(f"espeak-ng has no voice {name!r}")

    spoken = []
    for sentence, voice in zip(sentences, voices, strict=True):
        for parameter, value in (
            (_RATE, voice.rate),
            (_PITCH, voice.pitch),
            (_RANGE, voice.pitch_range),
        ):
            library.espeak_SetParameter(parameter, value, 0)
        blocks.clear()
        text = _ssml(sentence).encode()
        library.espeak_Synth(
            text, len(text) + 1, 0, _POSITION_CHARACTER, 0, _UTF8 | _SSML, None, None
        )
        library.espeak_Synchronize()
        if not blocks:
            raise RuntimeError(f"espeak-ng said nothing for {sentence!r} with {name!r}")
        spoken.append(np.concatenate(blocks).astype(np.float32) / 32768.0)
    library.espeak_Terminate()
    return spoken, rate


def _ssml(sentence: str) -> str:
    """`so *very* good`, with an emphasis element in place of the asterisks."""
    parts = escape(sentence).split("*")
    return "".join(
        f'<emphasis level="strong">{part}</emphasis>' if k % 2 else part
        for k, part in enumerate(parts)
    )
