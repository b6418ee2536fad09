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
from itertools import takewhile
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
RATE, FPS, CLOSED, LAGS, JAW = 16_000, 30, 0.02, range(-9, 10), 66
VOWELS = "aeiouAEIOUV03@"


class Event(ctypes.Structure):
    """espeak_EVENT of speak_lib.h."""

    _fields_ = [
        *((name, ctypes.c_int) for name in ("type", "id", "text", "length", "ms", "sample")),
        *(("user", ctypes.c_void_p), ("phone", ctypes.c_char * 8)),
    ]


_SOUND, _EVENTS = ctypes.POINTER(ctypes.c_short), ctypes.POINTER(Event)
CALLBACK = ctypes.CFUNCTYPE(ctypes.c_int, _SOUND, ctypes.c_int, _EVENTS)
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
        for event in takewhile(lambda event: event.type, events):
            if event.type == PHONEME:
                marks.append((event.phone.decode(), event.sample / rate))
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


def lips(voice: str, method: str, aligned: bool, snr: float | None) -> dict[str, tuple[float, int]]:
    """Return how often lips are closed at p, b and m, in vowels and in pauses, and of how many."""
    counts = {"p, b, m": [], "vowels": [], "pauses": []}
    for (wave, phones), text in zip(spoken(voice), SENTENCES, strict=True):
        if snr is not None:
            level = 10 ** ((wave.active_level() - snr) / 20)
            noise = np.random.default_rng(0).standard_normal(len(wave.samples)) * level
            wave = replace(wave, samples=wave.samples + noise.astype(np.float32))
        n = wave.n_frames(FPS)
        face = face_from_speech(wave, FPS, n, method, text if aligned else None)
        times = np.arange(n) / FPS
        closed = face.channel("jawOpen") - face.channel("mouthClose") <= CLOSED
        for name, start, end in phones:
            if name in ("p", "b", "m"):
                near = abs(times - (start + end) / 2) <= (end - start) / 2 + 0.5 / FPS
                counts["p, b, m"].append(closed[near].any())
            elif name and name[0] in VOWELS:
                counts["vowels"] += closed[(times >= start) & (times < end)].tolist()
            elif name.startswith("_"):
                counts["pauses"] += closed[(times >= start + 0.15) & (times < end - 0.1)].tolist()
    return {name: (float(np.mean(flags)), len(flags)) for name, flags in counts.items()}


def correlations(wave: af.Wave, jaw: np.ndarray, method: str) -> np.ndarray:
    """Return r of jawOpen with a recorded jaw, r at each of LAGS, 95 % quantile of other shifts."""
    if method == "loudness":
        made = wave.rms(np.arange(len(jaw)) / FPS, 0.1)
    else:
        made = face_from_speech(wave, FPS, len(jaw), method).channel("jawOpen")
    most = LAGS[-1]
    shifts = [np.roll(made, k) for k in range(most + 1, len(jaw) - most)]
    inner = [made[most + lag : len(made) - most + lag] for lag in LAGS]
    row = [np.corrcoef(made, jaw)[0, 1]]
    row += [np.corrcoef(part, jaw[most:-most])[0, 1] for part in inner]
    return np.array([*row, np.quantile([np.corrcoef(part, jaw)[0, 1] for part in shifts], 0.95)])


def recorded(folder: Path, chosen_on: str) -> None:
    files = sorted(folder.glob("*.npz"))
    chosen = np.array([file.stem.startswith(chosen_on) for file in files])
    sounds = [af.Wave.load(file.with_suffix(".wav")) for file in files]
    jaws = [np.load(file)["poses"][:, JAW] for file in files]
    for method in ("loudness", "energy", "phones"):
        rows = [correlations(*pair, method) for pair in zip(sounds, jaws, strict=True)]
        for label, group in (("chosen on", chosen), ("others", ~chosen), ("all", chosen | True)):
            some = np.array(rows)[group]
            r, *curve, chance = some.mean(axis=0)
            lag = 1000 * LAGS[int(np.argmax(curve))] / FPS
            each = " ".join(f"{value:.2f}" for value in some[:, 0])
            print(f"{method} | {label} | {r:.3f} | {each} | {chance:.2f} | {lag:+.0f} ms late")


def speed_and_blinks() -> None:
    samples = np.concatenate([wave.resample(RATE).samples for wave, _ in spoken(VOICES[0])])
    wave = af.Wave(np.resize(samples, 180 * RATE), RATE)
    for method in ("energy", "phones"):
        begun = time.process_time()
        lids = face_from_speech(wave, FPS, 180 * FPS, method).channel("eyeBlinkLeft")
        speed = 180 / (time.process_time() - begun)
        blinks = np.flatnonzero(np.diff((lids > 0.5).astype(int)) == 1) // (60 * FPS)
        print(f"{method}: {speed:.0f} x real time, blinks a minute {np.bincount(blinks).tolist()}")
    live, begun = EnergyFace(RATE, FPS), time.process_time()
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
            for method, aligned in (("phones", True), ("phones", False), ("energy", False)):
                label = f"{voice}, SNR {snr or 'none'}, {method}{', transcript' * aligned}"
                shares = lips(voice, method, aligned, snr)
                print(f"{label} |", " | ".join(f"{share:.0%}" for share, _ in shares.values()))
    if options.recordings:
        recorded(options.recordings, options.chosen_on)


if __name__ == "__main__":
    main()
