"""Configuration of a user study: the schema of the YAML file of `gesturekit study build`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

from gesturekit.evaluation.statistics.answers import MISMATCHED
from gesturekit.training.config import Limits, Settings, load_config, path_from
from gesturekit.viewer.drawn_body import BODIES, is_body

MOST_SLIDERS = 12
"""Systems on one page: each has a 3D player, and browsers allow about 16."""
_WEB_ADDRESS = re.compile(r"""https?://[^\s"'<>;,/?#\[]+[^\s"'<>;,]*""", re.I)


@dataclass(frozen=True)
class StudyConfig(Settings):
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
    pairs: Annotated[int | None, Limits(is_above=True)] = None
    """Comparisons (pages, with design `rating`) of one rater, attention checks not counted; all
    segments by default."""
    lists: Annotated[int, Limits(1000, is_above=True)] = 24
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

    def problems(self) -> Iterator[str]:
        """Yield what is wrong, the first first: later tests rest on earlier ones."""
        if not self.title.strip():
            yield "title is empty; it is the heading that raters see"
        least = 1 if self.design == "mismatch" else 2
        if len(self.systems) < least:
            yield f"systems: {len(self.systems)} given; design {self.design} needs {least} or more"
        if self.design == "rating" and len(self.systems) > MOST_SLIDERS:
            yield f"systems: {len(self.systems)} given; design rating has at most {MOST_SLIDERS}"
        if self.design == "rating" and self.reasons != "none":
            yield f"reasons: {self.reasons} is for pairs; design rating asks for none"
        if self.design == "mismatch" and self.sound == "none":
            yield "sound: design mismatch asks about the sound; it cannot be none"
        if bool(self.styles) != (self.design == "style"):
            need = "needs styles" if self.design == "style" else "has no styles"
            yield f"styles: design {self.design} {need} (NAME: words of the question)"
        for key, expected in (("systems", "NAME: FOLDER"), ("styles", "NAME: WORDS")):
            for name, text in getattr(self, key).items():
                if not (isinstance(name, str) and isinstance(text, str) and name.strip()):
                    yield f"{key}: {name!r}: {text!r}; expected {expected}"
                if name.endswith(MISMATCHED):
                    yield f"{key}: {name!r} ends in {MISMATCHED}: choose another name"
        if not is_body(self.body):
            yield f"body: {self.body!r}; expected {', '.join(BODIES)}, .vrm or .glb"
        if self.answers is not None and len(self.answers) != 5:
            yield f"answers: {len(self.answers)} given; five are expected"
        for key in ("post_url", "completion_url"):
            url = getattr(self, key)
            if url is not None and not _WEB_ADDRESS.fullmatch(url):
                yield f"{key}: {url!r} is not a web address; expected https://..."


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
