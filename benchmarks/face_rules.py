"""Faces made by rules: the jaw against recorded jaws, lips against espeak-ng's own phone times.

The folder of recordings has pairs STEM.npz (SMPL-X `poses`, joint 22 is the jaw) and STEM.wav. The
table of visemes comes from the literature; the band and the width of smoothing were chosen on the
recordings whose names begin with `--chosen-on`, so only the others say what to expect.
"""

from __future__ import annotations

import ctypes
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import espeakng_loader
import numpy as np
from harness import common_options

import audio_features as af
from gesturekit.face import EnergyFace, face_from_speech

SENTENCES = (
    "Bob made a map of my farm. Please pay the baker five pounds, maybe.",
    "My mother bought a big purple umbrella, but I prefer the small brown one.",
    "Put the paper by the lamp. Some people prefer to jump, and a number of them climb.",
    "I hope we will become members of the club. Perhaps Peter may bring a camera.",
    "The simple problem became impossible. Remember to stop before the bridge.",
    "He said this is the easiest thing to do. Nine children sing in a garden.",
)
VOICES = ("en-us", "en-us+f3")
FPS, CLOSED, LAGS = 30, 0.02, range(-9, 10)
VOWELS = "aeiouAEIOUV03@"


class Event(ctypes.Structure):
    """espeak_EVENT of speak_lib.h."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("type", "id", "text", "length", "ms", "sample")),
        *(("user", ctypes.c_void_p), ("phone", ctypes.c_char * 8)),
    ]


CALLBACK = ctypes.CFUNCTYPE(
    ctypes.c_int, ctypes.POINTER(ctypes.c_short), ctypes.c_int, ctypes.POINTER(Event)
)
PHONEME = 7


@cache
def spoken(voice: str) -> list[tuple[af.Wave, list[tuple[str, float, float]]]]:
    """Return each sentence with its phones: name, start and end in seconds."""
    library = ctypes.CDLL(espeakng_loader.get_library_path())
    rate = library.espeak_Initialize(2, 0, espeakng_loader.get_data_path().encode(), 0x8001)
    blocks, marks, result = [], [], []

    def collect(samples, count, events) -> int:
        if samples and count > 0:
            blocks.append(np.ctypeslib.as_array(samples, (count,)).copy())
        i = 0
        while events[i].type:
            if events[i].type == PHONEME:
                marks.append((events[i].phone.decode(), events[i].sample / rate))
            i += 1
        return 0

    callback = CALLBACK(collect)
    library.espeak_SetSynthCallback(callback)
    assert library.espeak_SetVoiceByName(voice.encode()) == 0, voice
    for sentence in SENTENCES:
        blocks.clear(), marks.clear()
        text = sentence.encode()
        library.espeak_Synth(text, len(text) + 1, 0, 1, 0, 1, None, None)
        wave = af.Wave.from_array(np.concatenate(blocks), rate)
        ends = [*(start for _, start in marks[1:]), wave.duration]
        phones = [(name.strip("',"), s, e) for (name, s), e in zip(marks, ends, strict=True)]
        result.append((wave, phones))
    return result


def lips(voice: str, method: str, told: bool, snr: float | None) -> dict[str, tuple[float, int]]:
    """Return how often lips are closed at p, b and m, in vowels and in pauses, and of how many."""
    counts = {"p, b, m": [], "vowels": [], "pauses": []}
    for (wave, phones), text in zip(spoken(voice), SENTENCES, strict=True):
        if snr is not None:
            level = 10 ** ((wave.active_level() - snr) / 20)
            noise = np.random.default_rng(0).standard_normal(len(wave.samples)) * level
            wave = replace(wave, samples=wave.samples + noise.astype(np.float32))
        n = wave.n_frames(FPS)
        face = face_from_speech(wave, FPS, n, method, text if told else None)
        opening = face.channel("jawOpen") - face.channel("mouthClose")
        times = np.arange(n) / FPS
        for name, start, end in phones:
            if name in ("p", "b", "m"):
                near = opening[(times >= start - 0.5 / FPS) & (times <= end + 0.5 / FPS)]
                counts["p, b, m"].append(near.min() <= CLOSED)
            inside = opening[(times >= start) & (times < end)] <= CLOSED
            if name and name[0] in VOWELS:
                counts["vowels"] += inside.tolist()
            middle = opening[(times >= start + 0.15) & (times < end - 0.1)] <= CLOSED
            if name.startswith("_"):
                counts["pauses"] += middle.tolist()
    return {name: (float(np.mean(flags)), len(flags)) for name, flags in counts.items()}


def correlations(wave: af.Wave, jaw: np.ndarray, method: str) -> tuple[np.ndarray, float]:
    """Return r of jawOpen with a recorded jaw at each lag, and the mean r of circular shifts."""
    if method == "loudness":
        made = wave.rms(np.arange(len(jaw)) / FPS, 0.1)
    else:
        made = face_from_speech(wave, FPS, len(jaw), method).channel("jawOpen")
    shifted = [np.corrcoef(np.roll(made, k), jaw)[0, 1] for k in range(-len(jaw) // 2, -9)]
    shifted += [np.corrcoef(np.roll(made, k), jaw)[0, 1] for k in range(10, len(jaw) // 2)]
    inner = jaw[9:-9]
    at = [np.corrcoef(made[9 - lag : len(made) - 9 - lag], inner)[0, 1] for lag in LAGS]
    at[len(at) // 2] = np.corrcoef(made, jaw)[0, 1]
    return np.array(at), float(np.quantile(shifted, 0.95))


def recorded(folder: Path, chosen_on: str) -> None:
    table = {}
    for method in ("loudness", "energy", "phones"):
        for file in sorted(folder.glob("*.npz")):
            jaw = np.load(file)["poses"][:, 66]
            pair = correlations(af.Wave.load(file.with_suffix(".wav")), jaw, method)
            table.setdefault(method, {})[file.stem] = pair
    for method, rows in table.items():
        groups = {"chosen on": True, "others": False}
        for label, chosen in groups.items():
            some = [pair for stem, pair in rows.items() if stem.startswith(chosen_on) == chosen]
            curves = np.mean([curve for curve, _ in some], axis=0)
            lag, chance = LAGS[int(curves.argmax())], np.mean([chance for _, chance in some])
            each = " ".join(f"{curve[9]:+.2f}" for curve, _ in some)
            print(
                f"{method:9} {label:10} r {curves[9]:+.3f} ({each}), highest {curves.max():.3f} at "
                f"{1000 * lag / FPS:+.0f} ms, 95 % of circular shifts of a clip below {chance:.2f}"
            )


def speed_and_blinks() -> None:
    words, _ = zip(*(pair for voice in VOICES for pair in spoken(voice)), strict=True)
    samples = np.concatenate([wave.resample(16_000).samples for wave in words])
    wave = af.Wave(np.tile(samples, 1 + 180 * 16_000 // len(samples))[: 180 * 16_000], 16_000)
    for method in ("energy", "phones"):
        begun = time.process_time()
        face = face_from_speech(wave, FPS, 180 * FPS, method)
        speed = 180 / (time.process_time() - begun)
        blinks = np.flatnonzero(np.diff((face.channel("eyeBlinkLeft") > 0.5).astype(int)) == 1)
        counts = np.bincount(blinks // (60 * FPS), minlength=3).tolist()
        print(f"{method}: {speed:.0f} x real time, blinks in each minute {counts}")
    live, begun = EnergyFace(16_000, FPS), time.process_time()
    for first in range(0, len(wave.samples), 640):
        live.step(wave.samples[first : first + 640])
    speed = 180 / (time.process_time() - begun)
    print(f"live in blocks of 40 ms: {speed:.0f} x real time, {1000 * live.delay:.0f} ms behind")


def main() -> None:
    parser = common_options(__doc__.splitlines()[0])
    parser.add_argument("--recordings", type=Path, help="folder of STEM.npz and STEM.wav")
    parser.add_argument("--chosen-on", default="", help="first letters of their names")
    options = parser.parse_args()
    speed_and_blinks()
    for voice in VOICES:
        for snr in (None, 20.0, 10.0):
            for method, told in (("phones", True), ("phones", False), ("energy", False)):
                label = f"{voice}, SNR {snr or 'none'}, {method}{' of a transcript' * told}"
                print(f"{label}: closed at {lips(voice, method, told, snr)}")
    if options.recordings:
        recorded(options.recordings, options.chosen_on)


if __name__ == "__main__":
    main()
