"""State of movement of the motions of a request: drawn, given, or that of a motion to redo."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.diffusion.sampling.expert_weights import style_weights
from gesturekit.diffusion.sampling.request import Request
from gesturekit.diffusion.state import measured
from gesturekit.diffusion.trained_model import TrainedModel
from gesturekit.errors import ModelError
from gesturekit.state.files import given_state
from gesturekit.training.seeds import rng_for


def drawn_style(n_styles: int, seed: int, item: str, number: int) -> int:
    """Return the random style of the sample of an item with this number."""
    rng = rng_for(seed, item, "sample", number, "style")
    return int(torch.randint(n_styles, (), generator=rng))


@dataclass(frozen=True, eq=False)
class DrawnState:
    """Source of the state of movement, one for all experts of a product.

    Attributes:
        model: whose process draws it.
        speech: (S, T) its features; S is 0 without speech input.
        style: number of the style of which it is; None for a random one, if there are styles.
        controls: of the request.
        values: (C, T) channels that are given; None to draw them.
    """

    model: TrainedModel
    speech: np.ndarray
    style: int | None
    controls: DiffusionControls
    values: np.ndarray | None

    @classmethod
    def of(
        cls, models: Sequence[TrainedModel], styles: Sequence[str | None], request: Request
    ) -> DrawnState | None:
        """Return that of the first model with a state, with its style; None without any."""
        for model, name in zip(models, styles, strict=False):
            if model.state_process is None:
                continue
            style = None
            if model.styles and name is not None:
                weights = style_weights(model.styles, name, request.n_frames, request.fps)
                style = int(weights.sum(axis=0).argmax())
            columns = model.conditions.columns["speech"]
            speech = request.condition(model.conditions)[:, columns].T
            return cls(model, speech, style, request.controls, _known(model, request))
        return None

    def of_sample(self, seed: int, item: str, number: int) -> np.ndarray:
        """Return the channels (C, T) of the sample of an item with this number."""
        if self.values is not None:
            return self.values
        assert self.model.state_process is not None
        controls, style, n_styles = self.controls, self.style, len(self.model.styles)
        if style is None and n_styles:
            style = drawn_style(n_styles, seed, item, number)
        mood_seed = seed if controls["mood_seed"] is None else int(controls["mood_seed"])
        rng = rng_for(mood_seed, item, "sample", number, "mood")
        return self.model.state_process.draw(
            rng.initial_seed() >> 1,
            self.speech,
            (controls["speaker"], style),
            liveliness=controls["liveliness"],
        )


def _known(model: TrainedModel, request: Request) -> np.ndarray | None:
    """Return the state (C, T) that is given, or that of the motion to redo; None for neither."""
    process, start = model.state_process, request.start
    assert process is not None
    if request.controls["state"] is not None:
        return given_state(process, request.controls["state"], request.n_frames).T
    if start is None:
        return None
    vectors = model.normaliser.inverse(start.clean(request.n_frames).cpu()).numpy()
    return measured(vectors, model.representation, process.channels, process.fps)


def check_guidance(controls: DiffusionControls, model: TrainedModel) -> None:
    """Raise ModelError for guidance on the state by a model that cannot leave it away."""
    if (gamma := controls["state_guidance"]) is not None and "state" not in model.droppable:
        raise ModelError(
            f"state_guidance={gamma:g}: this model was trained without dropout of the state "
            "(training.dropout_state above 0)"
        )
