"""The page of a study: a folder with index.html and the clips, which needs no server."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
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
from gesturekit.motion import Motion
from gesturekit.progress import Progress
from gesturekit.study.clips import Material, Segment, find_clips
from gesturekit.study.config import StudyConfig, introduction
from gesturekit.study.lists import Comparison, make_lists, mismatches
from gesturekit.viewer import player_data, player_shell
from gesturekit.viewer.pages import bundled_script, script_json, write_page
from gesturekit.wording import counted

CODES = (
    "LeftClearlyBetter",
    "LeftSlightlyBetter",
    "TheyAreEqual",
    "RightSlightlyBetter",
    "RightClearlyBetter",
)
"""GENEA's codes of the five answers."""
_PREFERENCE = (
    "Clear preference for left",
    "Slight preference for left",
    "No preference",
    "Slight preference for right",
    "Clear preference for right",
)
_STYLE = (
    "Clearly the left one",
    "Probably the left one",
    "I can not tell",
    "Probably the right one",
    "Clearly the right one",
)
_SCALE = ("Bad", "Poor", "Fair", "Good", "Excellent")
_QUESTIONS = {
    "preference speech": "Which character's motion do you prefer, taking into account both how "
    "natural-looking the motion is and how well it matches the speech rhythm and intonation?",
    "preference music": "Which character's dancing motion do you prefer, taking into account both "
    "how natural-looking the motion is and how well it matches the music?",
    "preference silent": "Which character's motion do you prefer?",
    "rating speech": "How natural is the motion of each character, taking into account both how it "
    "looks and how well it matches the speech?",
    "rating music": "How natural is the dancing of each character, taking into account both how it "
    "looks and how well it matches the music?",
    "rating silent": "How natural does the motion of each character look?",
    "style silent": "Based on the body movements alone (disregarding the face), which of the two "
    "clips looks most like *{style}*?",
    "mismatch speech": "In which of the two clips do the movements match the speech better?",
    "mismatch music": "In which of the two clips do the movements match the music better?",
}
"""Question by design and sound: the diffusion paper's and, for mismatched motion, GENEA's."""
REASONS = {
    "none": {},
    "realism": {
        "MotionSmoothness": "Smoothness of the motion",
        "AmountIntensityOfMotion": "Amount or intensity of motion",
        "RecognisableGestures": "Recognisable gestures",
        "UnrealisticMotion": "Unrealistic motion in the other clip",
        "MotionOther": "Something else",
    },
    "speech": {
        "FitRhythmTiming": "Fits the rhythm and timing",
        "EmphasizeCorrectParts": "Emphasises the right parts",
        "BetterMatchContentMeaning": "Matches the content or meaning",
        "BetterFitForEmotion": "Fits the emotion",
        "SpeechOther": "Something else",
    },
}
"""GENEA's codes of reasons, with our words."""
_BODY = "body"
"""Script of the mesh of all clips' bodies; as `SHARED` in page/clip.js."""
_HERE = Path(__file__).parent
_BUNDLE = _HERE / "study.bundle.js"


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


def build_study(
    config: StudyConfig,
    out: str | os.PathLike[str],
) -> BuiltStudy:
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
    material = find_clips(config)
    others = {}
    if config.design == "mismatch":
        if len(material.segments) < 2:
            raise ConfigError("design mismatch: needs at least two segments, found 1")
        others = mismatches(material.segments, config.seed)
    lists = make_lists(config, material.segments)
    if config.pairs is not None and (most := len(lists[0])) < config.pairs:
        warnings.warn(
            f"pairs: {config.pairs}, but a rater sees a segment once, and there are "
            f"{counted(len(material.segments), 'segment')}: {counted(most, 'comparison')} a rater",
            stacklevel=2,
        )
    if material.videos and config.body != "mannequin":
        raise ConfigError(f"body: {config.body} is for motions; the clips are videos")
    clips = _Clips(config, material, others)
    page_lists = [[clips.trial(comparison) for comparison in one] for one in lists]
    clips.write(out)
    values = {
        "title": html.escape(config.title),
        "policy": html.escape(_policy(config.post_url)),
        "setup": script_json(_setup(config, material, page_lists, out)),
        "shell": script_json("" if material.videos else player_shell()),
        "script": script,
    }
    page = out / "index.html"
    write_page(page, _HERE / "page", values)
    return BuiltStudy(
        page, len(material.segments), len(clips.sources), len(lists[0]), page.stat().st_size
    )


class _Clips:
    """Clips that the lists use, each once, under names that tell nothing.

    Attributes:
        sources: {(system, segment, segment of the sound): name}.
    """

    def __init__(self, config: StudyConfig, material: Material, others: dict[str, Segment]) -> None:
        self.config, self.material, self.others = config, material, others
        self.sources: dict[tuple[str, str, str], str] = {}
        self.segments = {segment.name: segment for segment in material.segments}
        self.seconds: dict[str, float] = {}
        self._sides: list[tuple[dict[str, Any], str]] = []

    def trial(self, comparison: Comparison) -> dict[str, Any]:
        """Return a comparison as the page reads it."""
        segment, names = comparison.segment, comparison.systems
        sides = [self._side(name, segment) for name in names]
        trial: dict[str, Any] = {"clip": segment.name, "systems": names, "sides": sides}
        return trial | ({"style": segment.style} if segment.style else {})

    def _side(self, name: str, segment: Segment) -> dict[str, Any]:
        system = name.removesuffix(MISMATCHED)
        shown = segment if system == name else self.others[segment.name]
        if not self.material.videos:
            motion = self._name(system, shown, segment)
            side: dict[str, Any] = {"motion": motion}
            self._sides.append((side, motion))
            return side
        side = {"video": self._name(system, shown, shown), "silent": self.config.is_silent}
        if shown is not segment:
            side["sound"] = self._name(system, segment, segment)
        return side

    def _name(self, system: str, shown: Segment, spoken: Segment) -> str:
        key = (system, shown.name, spoken.name)
        suffix = shown.clips[system].suffix.lower() if self.material.videos else ""
        return self.sources.setdefault(key, f"c{len(self.sources) + 1:04d}{suffix}")

    def write(self, out: Path) -> None:
        """Write all clips, and the lengths of motions into the comparisons."""
        sources, mesh = Progress(self.sources.items(), unit="clip"), None
        for (system, shown, spoken), name in sources:
            source = self.segments[shown].clips[system]
            if self.material.videos:
                with atomic_write(out / "clips" / name) as temporary:
                    shutil.copyfile(source, temporary)
            else:
                sound = self.segments[spoken].sound
                motion, seconds = _loaded(source, sound)
                self.seconds[name] = seconds
                clip = json.loads(player_data(motion, sound, body=self.config.body, compress=True))
                if "skin" in clip:  # a mesh that all clips share
                    mesh, clip["skin"] = clip["skin"], _BODY
                _write_script(out / "clips" / f"{name}.js", clip)
        if mesh is not None:
            _write_script(out / "clips" / f"{_BODY}.js", mesh)
        for side, name in self._sides:
            side["seconds"] = self.seconds[name]


def _loaded(source: Path, sound: Path | None) -> tuple[Motion, float]:
    """Return a motion, and the seconds that both it and its sound last."""
    motion = load(source, {}, {})
    seconds = motion.duration
    if sound is not None:
        seconds = min(seconds, Wave.load(sound).duration)
    return motion, round(seconds, 3)


def _write_script(path: Path, value: object) -> None:
    """Write a value as a script: the only kind of file that a page opened from a disk may read."""
    write_text(path, f'gesturekitClip("{path.stem}",{script_json(value)});\n')


def _setup(
    config: StudyConfig, material: Material, lists: Sequence[Any], out: Path
) -> dict[str, Any]:
    silent = config.is_silent or not (material.videos or material.segments[0].sound)
    usual = _QUESTIONS[f"{config.design} {'silent' if silent else config.sound}"]
    question = config.question or usual
    texts = config.answers or {"style": _STYLE, "rating": _SCALE}.get(config.design, _PREFERENCE)
    return {
        "format": 1,
        "name": re.sub(r"[^\w.-]+", "_", out.resolve().name) or "study",
        "title": config.title,
        "introduction": config.introduction or introduction(config, silent),
        "consent": config.consent or "",
        "question": question,
        "styles": [
            {"name": name, "question": question.replace("{style}", words)}
            for name, words in config.styles.items()
        ],
        "answers": [{"code": c, "text": t} for c, t in zip(CODES, texts, strict=True)],
        "scale": texts if config.design == "rating" else None,
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


def _policy(post_url: str | None) -> str:
    """Return what the page may load: its own clips, and nothing from elsewhere."""
    # Browsers differ in whether 'self' includes other files of a disk.
    rules = {
        "default-src": "'none'",
        "script-src": "'unsafe-inline' 'self' file:",
        "style-src": "'unsafe-inline'",
        "media-src": "'self' file: blob:",
        "img-src": "data: blob:",
        "connect-src": post_url or "'none'",
    }
    return "; ".join(f"{name} {value}" for name, value in rules.items())
