"""Summary of a feature file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import audio_features as af
from gesturekit.inspection.summary import Summary, size, span
from gesturekit.wording import counted, listed

_SHOWN = 12


def inspect_features(path: Path) -> Summary:
    """Summarise a feature file (npz of values, times and spec).

    Raises:
        FeatureError: it cannot be read.
    """
    track = af.FeatureTrack.load(path)
    n_frames, n_columns = track.values.shape
    step = float(np.median(np.diff(track.times))) if n_frames > 1 else None
    mean, spread = track.values.mean(axis=0), track.values.std(axis=0)
    facts = {
        "path": str(path),
        "bytes": path.stat().st_size,
        "frames": n_frames,
        "columns": n_columns,
        "names": list(track.names),
        "first": float(track.times[0]),
        "last": float(track.times[-1]),
        "rate": 1 / step if step else None,
        "spec": track.spec,
        "mean": mean,
        "sd": spread,
    }
    rows = [
        (
            "time",
            f"{span(track.times[-1] - track.times[0])}: {counted(n_frames, 'frame')}"
            + (f" at {1 / step:.6g} a second" if step else "")
            + f", centred from {track.times[0]:.4f} to {track.times[-1]:.4f} s",
        ),
        ("columns", f"{n_columns}: {listed(track.names, _SHOWN)}"),
        ("values", f"{track.values.min():.4g} to {track.values.max():.4g}"),
        ("made by", json.dumps(track.spec, ensure_ascii=False) if track.spec else "unknown"),
    ]
    still = [name for name, sd in zip(track.names, spread) if sd == 0]
    problems = (f"never change: {listed(still, _SHOWN)}",) if still and n_frames > 1 else ()
    return Summary(
        kind="features",
        title=f"{path}: features of a sound, {size(facts['bytes'])}",
        facts=facts,
        rows=tuple(rows),
        problems=problems,
    )
