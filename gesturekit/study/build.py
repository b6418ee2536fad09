"""The page of a study: a folder with index.html and the clips, which needs no server."""

from __future__ import annotations

import html
import json
import math
import os
import re
import shutil
import tomllib
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from audio_features import Wave
from audio_features.atomic import atomic_write, write_text
from gesturekit.errors import ConfigError
from gesturekit.evaluation.statistics.answers import MISMATCHED, MOST_COMMENT
from gesturekit.formats.sources import load
from gesturekit.progress import Progress
from gesturekit.study.clips import Segment, find_clips
from gesturekit.study.config import StudyConfig
from gesturekit.study.lists import Comparison, make_lists, mismatches
from gesturekit.viewer import player_data, player_shell
from gesturekit.viewer.pages import bundled_script, script_json, write_page
from gesturekit.wording import counted

_HERE = Path(__file__).parent
_TEXTS = tomllib.loads((_HERE / "page" / "texts.toml").read_text(encoding="utf-8"))
CODES: tuple[str, ...] = tuple(_TEXTS["codes"])
"""GENEA's codes of the five answers."""
REASONS: dict[str, dict[str, str]] = _TEXTS["reasons"]
"""GENEA's codes of reasons, with our words, by `StudyConfig.reasons`."""
_BODY = "body"
"""Script of the mesh of all clips' bodies; as `SHARED` in page/clip.js."""
_BUNDLE = _HERE / "study.bundle.js"
Clips = dict[tuple[str, Segment, Segment], dict[str, Any]]
"""{(system, segment, segment of the sound): the clip as the page reads it}. Names of clips, c0001
and so on, tell nothing."""


@dataclass(frozen=True)
class BuiltStudy:
    """A study that was written.

    Attributes:
        page: index.html.
        segments, clips: numbers of speech segments and of clips in the folder.
        trials: comparisons of a rater, attention checks not counted.
        page_bytes: size of the page without its clips.
    """

    page: Path
    segments: int
    clips: int
    trials: int
    page_bytes: int


def build_study(config: StudyConfig, out: str | os.PathLike[str]) -> BuiltStudy:
    """Write the page of a study into a folder: index.html, and the clips in `clips/`.

    Names of clips do not tell raters the system. The page comes last, so that a folder with a page
    has all its clips.

    Args:
        config: see `load_study_config`.
        out: the folder.

    Raises:
        ConfigError: no clips that fit, or fewer than a design needs.
        GestureKitError: a clip that cannot be read, or scripts that were not bundled.
    """
    out = Path(out)
    script = bundled_script(_BUNDLE, "the script of the study pages")
    segments = find_clips(config)
    are_videos = segments[0].is_video
    if config.design == "mismatch" and len(segments) < 2:
        raise ConfigError("design mismatch: needs at least two segments, found 1")
    if are_videos and config.body != "mannequin":
        raise ConfigError(f"body: {config.body} is for motions; the clips are videos")
    others = mismatches(segments, config.seed) if config.design == "mismatch" else {}
    lists = make_lists(config, segments)
    if config.pairs is not None and (most := len(lists[0])) < config.pairs:
        warnings.warn(
            f"pairs: {config.pairs}, but a rater sees a segment once, and there are "
            f"{counted(len(segments), 'segment')}: {counted(most, 'comparison')} a rater",
            stacklevel=2,
        )
    clips: Clips = {}
    trials = [[_trial(config, one, others, clips) for one in comparisons] for comparisons in lists]
    _write_clips(config, clips, out / "clips")
    silent = config.is_silent or not (are_videos or segments[0].sound)
    values = {
        "title": html.escape(config.title),
        # Beside this address, the page may load its own clips; some browsers do not count other
        # files of a disk as 'self'.
        "post_url": html.escape(config.post_url or "'none'"),
        "setup": script_json(_setup(config, silent, trials, out)),
        "shell": script_json("" if are_videos else player_shell()),
        "script": script,
    }
    page = out / "index.html"
    write_page(page, _HERE / "page", values)
    return BuiltStudy(page, len(segments), len(clips), len(lists[0]), page.stat().st_size)


def _trial(
    config: StudyConfig, comparison: Comparison, others: dict[str, Segment], clips: Clips
) -> dict[str, Any]:
    """Return a comparison as the page reads it; what it shows is added to `clips`."""

    def clip(system: str, shown: Segment, spoken: Segment) -> dict[str, Any]:
        name = f"c{len(clips) + 1:04d}"
        if not shown.is_video:
            return clips.setdefault((system, shown, spoken), {"motion": name})
        video = {"video": name + shown.clips[system].suffix.lower(), "silent": config.is_silent}
        return clips.setdefault((system, shown, spoken), video)

    segment, systems = comparison
    sides = []
    for name in systems:
        system = name.removesuffix(MISMATCHED)
        shown = segment if system == name else others[segment.name]
        side = clip(system, shown, shown if segment.is_video else segment)
        if segment.is_video and shown is not segment:
            side = side | {"sound": clip(system, segment, segment)["video"]}
        sides.append(side)
    trial: dict[str, Any] = {"clip": segment.name, "systems": systems, "sides": sides}
    return trial | ({"style": segment.style} if segment.style else {})


def _write_clips(config: StudyConfig, clips: Clips, folder: Path) -> None:
    """Write all clips, and add the `seconds` of motions to what the page reads."""
    mesh = None
    for (system, shown, spoken), side in Progress(clips.items(), unit="clip"):
        source, sound = shown.clips[system], spoken.sound
        if shown.is_video:
            with atomic_write(folder / side["video"]) as temporary:
                shutil.copyfile(source, temporary)
            continue
        motion = load(source, {}, {})
        sound_seconds = math.inf if sound is None else Wave.load(sound).duration
        side["seconds"] = round(min(motion.duration, sound_seconds), 3)
        clip = json.loads(player_data(motion, sound, body=config.body, compress=True))
        if "skin" in clip:  # a mesh that all clips share
            mesh, clip["skin"] = clip["skin"], _BODY
        _write_script(folder / f"{side['motion']}.js", clip)
    if mesh is not None:
        _write_script(folder / f"{_BODY}.js", mesh)


def _write_script(path: Path, value: object) -> None:
    """Write a value as a script: the only kind of file that a page opened from a disk may read."""
    write_text(path, f'gesturekitClip("{path.stem}",{script_json(value)});\n')


def _setup(config: StudyConfig, silent: bool, lists: Sequence[Any], out: Path) -> dict[str, Any]:
    rating = config.design == "rating"
    usual = _TEXTS["questions"][f"{config.design} {'silent' if silent else config.sound}"]
    question = config.question or usual
    words = _TEXTS["answers"]
    texts = config.answers or words.get(config.design, words["preference"])
    parts = _TEXTS["introduction"]
    introduction = parts["ratings" if rating else "pairs"] + parts["silent" if silent else "sound"]
    return {
        "format": 1,
        "name": re.sub(r"[^\w.-]+", "_", out.resolve().name) or "study",
        "title": config.title,
        "introduction": config.introduction
        or introduction + (parts["checks"] if config.attention_checks else ""),
        "consent": config.consent or "",
        "question": question,
        "styles": [
            {"name": name, "question": question.replace("{style}", words)}
            for name, words in config.styles.items()
        ],
        "answers": [{"code": c, "text": t} for c, t in zip(CODES, texts, strict=True)],
        "scale": texts if rating else None,
        "sound": config.sound_check and not silent,
        "practice": config.practice,
        "comment": MOST_COMMENT,
        "reasons": [{"code": c, "text": t} for c, t in REASONS[config.reasons].items()],
        "checks": config.attention_checks,
        "lists": lists,
        "post": config.post_url or "",
        "completion": config.completion_url or "",
        "seed": config.seed,
    }
