"""Controls of `DiffusionModel.generate`."""

# No `from __future__ import annotations` here: `control_entries` reads annotations as objects.
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

from gesturekit.model import Control, Controls

Solver = Literal["ancestral", "ddim", "dpm"]


class DiffusionControls(Controls, total=False):
    """Controls that diffusion models take beside those of every system.

    `style` may also be a mixture with weights, such as old:0.25,angry:0.75; each style is then one
    expert of a product. Without a style, each sample gets a random one.
    """

    events: Annotated[str | Path | None, Control(kind=None, metavar="NAME@SECONDS,...")]
    """Events and their times in seconds: kick@1.0,punch@2.5:0.5 (with a duration), kick@beats (on
    every beat of the sound), or a table time,name[,duration]."""
    guidance: Annotated[float | None, Control(kind=float, metavar="GAMMA")]
    """Weight gamma of classifier-free guidance (eq. 6): 1 is the plain model, values above 1
    exaggerate the style, 0 leaves it out. In models without styles, guidance applies to all
    conditions but the state of movement."""
    state_guidance: Annotated[float | None, Control(kind=float, metavar="GAMMA")]
    """Weight gamma of guidance on the state of movement, beside `guidance`: 1 is the plain model,
    and 0 leaves the state out."""
    unconditional: Annotated[Any, Control(kind=None, metavar="MODEL")]
    """The unconditional model for guidance; by default this model, without the style."""
    experts: Annotated[
        Sequence[tuple[Any, ...]],
        Control(
            (),
            kind=None,
            option="--expert",
            metavar="MODEL[:WEIGHT[:STYLE]]",
            note="On the command line, the option may be repeated: MODEL:0.2@0-10,0.8@10-20.",
        ),
    ]
    """Further experts of a product: (model, weight) or (model, weight, style). The weight is a
    number, one number per frame, a string such as 0.2@0-10,0.8@10-20 (seconds), or None. The
    remaining weight is shared equally by this model and all experts with None."""
    change: Annotated[float, Control(0.5, kind=float, above=0, most=1, metavar="SHARE")]
    """Share of `like` that may change, above 0 and up to 1: the noise level from which SDEdit
    starts."""
    solver: Annotated[Solver | None, Control(choices=get_args(Solver))]
    """Solver of the reverse diffusion: ancestral (as published), ddim, or dpm (second order). The
    default is ancestral if all steps are used, and dpm otherwise."""
    steps: Annotated[int | None, Control(kind=int, least=1, metavar="N", note="10 to 20 are fast.")]
    """Number of denoising steps; by default all that the model was trained with."""
    clip_denoised: Annotated[bool | None, Control(kind=bool, raw=False)]
    """Clip the predicted clean motion to 10 standard deviations, and skip the network at steps of
    almost pure noise (--no-clip-denoised: neither, as in the released code). The default is stored
    with the model."""
    batch: Annotated[int, Control(1, kind=int, least=1, metavar="N")]
    """Number of samples to generate at once. Larger batches are faster on a GPU; results then
    differ in the last digits from samples generated one by one."""
