"""Controls of models: one list of names a system, documented once, and errors for all others."""

import dataclasses

import pytest

import gesturekit as gk
from gesturekit.diffusion.controls import DiffusionControlArguments, DiffusionControls
from gesturekit.errors import ModelError
from gesturekit.field_docs import field_docs
from gesturekit.model import UnknownControlError
from gesturekit.multires.controls import MultiresControlArguments, MultiresControls


@pytest.mark.parametrize(
    ("controls", "arguments"),
    [(DiffusionControls, DiffusionControlArguments), (MultiresControls, MultiresControlArguments)],
)
def test_every_control_is_a_typed_keyword_and_documented(controls, arguments):
    names = {field.name for field in dataclasses.fields(controls)}
    assert names == arguments.__optional_keys__
    assert names == field_docs(controls).keys()


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
    for value in allowed:
        assert getattr(DiffusionControls.build({name: value}, "diffusion"), name) == value
    for value in refused:
        with pytest.raises(ModelError, match=f"(?=.*{name}={value!r}){says}"):
            DiffusionControls.build({name: value}, "diffusion")
