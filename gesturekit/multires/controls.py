"""Controls of `MultiresModel.generate`."""

# No `from __future__ import annotations` here: `control_entries` reads annotations as objects.
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from gesturekit.model import PLACING, Control, Controls
from gesturekit.motion.motion import Motion

if TYPE_CHECKING:
    import audio_features as af


class MultiresControls(Controls, total=False):
    """Controls that multires models take beside those of every system.

    Without a style, each sample gets a random one. At most one of `path`, `keyframes`, `like` and
    `keep` can be given; each of them except `like` sets the length if neither speech nor seconds is
    given.
    """

    level_style: Annotated[str | None, Control(metavar="LEVELS=NAME,...")]
    """Styles of single levels, counted from 1 (coarsest), which override style:
    1-4=describe,5-8=angry."""
    level_speech: Annotated[
        "Mapping[str, str | Path | af.Wave] | None", Control(kind=Path, metavar="LEVELS=FILE,...")
    ]
    """Speech of single levels, counted from 1 (coarsest), in place of the main speech:
    7-10=b.wav, in Python {"7-10": "b.wav"}. It is cut to the length of the motion, or continues
    with silence. The drawn state follows the main speech."""
    levels: Annotated[int | None, Control(kind=int, least=1, metavar="N", excludes=PLACING)]
    """Stop after this many levels. The motion has the lower frame rate of that level and can be
    edited and passed back as keyframes. Only style, level_style, speech and level_speech can be
    combined with it."""
    keyframes: Annotated[
        str | Path | Motion | None,
        Control(kind=Path, metavar="EDIT.bvh", excludes=(*PLACING, "path", "like", "keep")),
    ]
    """A motion that replaces the output of a coarse level; the finer levels add detail and keep its
    slow movement. If it is an edited copy of a motion generated with levels, the same seed and the
    same name, unedited frames are reproduced as generated. A motion on another rig is retargeted.
    The result has the model's own frame rate, unless fps is given."""
    keyframe_level: Annotated[int, Control(1, kind=int, least=1, metavar="N")]
    """The level that keyframes or like replaces, counted from 1 (coarsest)."""
