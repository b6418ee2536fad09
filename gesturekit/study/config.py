"""Configuration of a user study: the schema of the YAML file of `gesturekit study build`."""

from __future__ import annotations

import os
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal
from urllib.parse import urlsplit

from gesturekit.errors import ConfigError
from gesturekit.training.config import load_config, path_from
from gesturekit.viewer.drawn_body import BODIES, is_body

_PAIRS = """You will see pairs of short clips of a moving figure. Play both clips of a pair to the \
end, then answer the question below them."""
_RATINGS = """You will see several short clips of a moving figure on a page. Play each clip to the \
end, then rate it with the slider beside it, in comparison with the others."""
_INTRODUCTION = """ There are no right or wrong answers: we want to know how the motion looks \
to you.

"""
_WITH_SOUND = "*Please use headphones, and keep the sound on.*"
_WITHOUT_SOUND = "The clips have no sound."
_CHECKS = """ Some pages ask you, in a line of text on a clip, to give a certain answer: please \
do so. It shows us that you are paying attention."""


MOST_SLIDERS = 12
"""Systems on one page: each has a 3D player, and browsers allow about 16."""


def introduction(config: StudyConfig, silent: bool) -> str:
    """Return the default first screen, for clips with or without sound."""
    task = _RATINGS if config.design == "rating" else _PAIRS
    sound = _WITHOUT_SOUND if silent else _WITH_SOUND
    return f"{task}{_INTRODUCTION}{sound}{_CHECKS if config.attention_checks else ''}"


@dataclass(frozen=True)
class StudyConfig:
    """A user study.

    A clip of every system is needed for each speech segment, under the same path in the folder of
    each system (`ours/day1/take2.mp4`, `baseline/day1/take2.mp4`). Paths are relative to the file.
    """

    title: str
    """Heading of the page, shown to raters. It should not name the systems."""
    systems: dict[str, str]
    """Folder of clips by name of the system: videos with sound (mp4, webm), or motions (bvh, npz)
    that are shown in 3D."""
    design: Literal["preference", "style", "mismatch", "rating"] = "preference"
    """`preference`: two systems, same speech. `style`: which of two systems looks most like a
    style, without sound. `mismatch`: a system's motion against its own motion of other speech.
    `rating`: all systems on one page, each with a slider from 0 to 100 (HEMVIP)."""
    audio: Path | None = None
    """Folder of the speech of motions, under the same paths; videos have their own sound."""
    sound: Literal["speech", "music", "none"] = "speech"
    """Kind of sound, for the question: whether motion matches the speech, or a dance the music;
    `none` plays clips without it."""
    body: str = "mannequin"
    """Body of motions: mannequin, human, skeleton, or the file of a VRM avatar."""
    styles: dict[str, str] = field(default_factory=dict)
    """Words for the question by style, such as `happy: the person is happy`. The style of a clip is
    a folder or a part of its file name (`style`)."""
    question: str | None = None
    """Question below the clips; `*words*` are bold, `{style}` is the style's words.
    By default those of the diffusion paper, on gestures or dance (`sound`), and of GENEA."""
    answers: tuple[str, ...] | None = None
    """The five answers, from left clearly to right clearly; with design `rating`, the five words
    along the sliders, from 0 to 100."""
    reasons: Literal["none", "realism", "speech"] = "none"
    """Reasons that raters may give for a preference: GENEA's on realism or on speech."""
    introduction: str | None = None
    """First screen; an empty line begins a paragraph, `*words*` are bold."""
    consent: str | None = None
    """A sentence that raters must tick before they start."""
    sound_check: bool = True
    """Raters first say how many tones they hear, if the clips have sound."""
    practice: bool = True
    """Raters first answer once for practice; this answer is not stored."""
    pairs: int | None = None
    """Comparisons (pages, with design `rating`) of one rater, attention checks not counted; all
    segments by default."""
    lists: int = 24
    """Number of balanced lists. `?list=3` opens a certain one; other raters get one by their id."""
    attention_checks: int = 2
    """Attention checks of each rater."""
    post_url: str | None = None
    """Send answers there by HTTP POST (CSV as text). Without it they are downloaded as a file."""
    completion_url: str | None = None
    """Link at the end, such as Prolific's completion URL."""
    seed: int = 0
    """The same seed gives the same page, and the same order to the same rater."""

    @property
    def is_silent(self) -> bool:
        """True if clips are shown without their sound."""
        return self.design == "style" or self.sound == "none"

    def __post_init__(self) -> None:
        if not self.title.strip():
            raise ConfigError("title is empty; it is the heading that raters see")
        self._check_systems()
        if not is_body(self.body):
            raise ConfigError(f"body: {self.body!r}; expected {', '.join(BODIES)}, .vrm or .glb")
        for name, least in (("lists", 1), ("attention_checks", 0), ("seed", 0)):
            if getattr(self, name) < least:
                raise ConfigError(f"{name}: {getattr(self, name)} is below {least}")
        if self.lists > 1000:
            raise ConfigError(f"lists: {self.lists} is more than 1000")
        if self.pairs is not None and self.pairs < 1:
            raise ConfigError(f"pairs: {self.pairs}; a rater needs at least 1")
        if self.answers is not None and len(self.answers) != 5:
            raise ConfigError(f"answers: {len(self.answers)} given; five are expected")
        for name in ("post_url", "completion_url"):
            url = getattr(self, name)
            if url is not None and not _is_web_address(url):
                raise ConfigError(f"{name}: {url!r} is not a web address; expected https://...")
        self._check_styles()

    def _check_systems(self) -> None:
        least = 1 if self.design == "mismatch" else 2
        if len(self.systems) < least:
            raise ConfigError(
                f"systems: {len(self.systems)} given; design {self.design} needs {least} or more"
            )
        if self.design == "rating" and len(self.systems) > MOST_SLIDERS:
            raise ConfigError(
                f"systems: {len(self.systems)} given; design rating shows at most {MOST_SLIDERS}"
            )
        if self.design == "rating" and self.reasons != "none":
            raise ConfigError(f"reasons: {self.reasons} is for pairs; design rating asks for none")
        if self.design == "mismatch" and self.sound == "none":
            raise ConfigError("sound: design mismatch asks about the sound; it cannot be none")
        for name, folder in self.systems.items():
            if not isinstance(name, str) or not isinstance(folder, str) or not name.strip():
                raise ConfigError(f"systems: {name!r}: {folder!r}; expected NAME: FOLDER")
            if name.endswith("_Mismatched"):
                raise ConfigError(f"systems: {name!r} ends in _Mismatched: choose another name")

    def _check_styles(self) -> None:
        if bool(self.styles) != (self.design == "style"):
            need = "needs styles" if self.design == "style" else "has no styles"
            raise ConfigError(f"styles: design {self.design} {need} (NAME: words of the question)")
        for name, words in self.styles.items():
            if not isinstance(name, str) or not isinstance(words, str):
                raise ConfigError(f"styles: {name!r}: {words!r}; expected NAME: WORDS")


def _is_web_address(url: str) -> bool:
    try:
        parts = urlsplit(url)
    except ValueError:
        return False
    safe = not any(sign.isspace() or sign in "\"'<>;," for sign in url)
    return safe and parts.scheme in ("http", "https") and bool(parts.hostname)


def load_study_config(path: str | os.PathLike[str], overrides: tuple[str, ...] = ()) -> StudyConfig:
    """Read the configuration of a study; folders of systems become absolute.

    Raises:
        ConfigError: an unknown key, a wrong type, a value out of range.
    """
    config = load_config(Path(path), StudyConfig, overrides)
    here = Path(path).resolve().parent
    folders = {
        name: str(path_from(here, f"systems.{name}", f)) for name, f in config.systems.items()
    }
    body = config.body if config.body in BODIES else str(path_from(here, "body", config.body))
    return replace(config, systems=folders, body=body)
