"""Controls of models: one list of names a system, documented once, and errors for all others."""

from functools import partial

import pytest

import gesturekit as gk
from gesturekit.diffusion.controls import DiffusionControls
from gesturekit.errors import ModelError
from gesturekit.field_docs import field_docs
from gesturekit.model import Controls, UnknownControlError, build_controls, control_entries
from gesturekit.multires.controls import MultiresControls


@pytest.mark.parametrize("schema", [DiffusionControls, MultiresControls])
def test_every_control_is_an_optional_keyword_and_documented(schema):
    docs = field_docs(Controls) | field_docs(schema)
    assert control_entries(schema).keys() == schema.__optional_keys__ == docs.keys()


@pytest.mark.parametrize(
    ("system", "near", "meant", "other"),
    [("diffusion", "chang", "change", "levels"), ("multires", "keyfram", "keyframes", "guidance")],
)
def test_unknown_controls_are_refused_with_the_nearest_name(untrained, system, near, meant, other):
    model = untrained() if system == "diffusion" else gk.load("demo")
    for call in (model.generate, model.check_controls):
        with pytest.raises(UnknownControlError, match=rf"(?=.*\b{near}\b)(?=.*\b{meant}\b)"):
            call(**{near: 0.3})
        with pytest.raises(UnknownControlError, match=f"(?=.*{system})(?=.*{other})"):
            call(**{other: 2})
    model.check_controls(**{other: None, "style": None})


@pytest.mark.parametrize(
    ("name", "allowed", "refused", "says"),
    [
        ("steps", (1, 20), (0, -1, 1.0, True), r"(?=.*integer)(?=.*\b1\b)"),
        ("change", (1e-6, 1), (0, -0.1, 1.01), r"(?=.*\b0\b)(?=.*\b1\b)"),
        ("solver", ("ddim", "dpm"), ("euler", 2), "(?=.*ancestral)(?=.*dpm)"),
    ],
)
def test_controls_of_diffusion_are_checked(name, allowed, refused, says):
    build = partial(build_controls, DiffusionControls, kind="diffusion")
    defaults = build({})
    assert (defaults["change"], defaults["batch"]) == (0.5, 1)
    for value in allowed:
        assert build({name: value}) == defaults | {name: value}
    for value in refused:
        with pytest.raises(ModelError, match=f"(?=.*{name}={value!r}){says}"):
            build({name: value})
