"""Controls of diffusion models: one list of names, documented once, and errors for all others."""

from __future__ import annotations

import dataclasses

import pytest

from gesturekit.diffusion.controls import DiffusionControlArguments, DiffusionControls
from gesturekit.field_docs import field_docs
from gesturekit.model import UnknownControlError


def test_every_control_is_a_typed_keyword_and_documented():
    names = {field.name for field in dataclasses.fields(DiffusionControls)}
    assert names == DiffusionControlArguments.__optional_keys__
    assert names == field_docs(DiffusionControls).keys()


def test_unknown_controls_are_refused_with_the_nearest_name(untrained):
    model = untrained()
    for call in (model.generate, model.check_controls):
        with pytest.raises(UnknownControlError, match="no control chang; did you mean change"):
            call(chang=0.3)
        with pytest.raises(UnknownControlError, match="diffusion models have no control levels"):
            call(levels=2)
    model.check_controls(levels=None, steps=4)
