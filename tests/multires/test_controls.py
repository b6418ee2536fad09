"""Controls of multires models: one list of names, documented once, and errors for all others."""

from __future__ import annotations

import dataclasses

import pytest

import gesturekit as gk
from gesturekit.field_docs import field_docs
from gesturekit.model import UnknownControlError
from gesturekit.multires.controls import MultiresControlArguments, MultiresControls


def test_every_control_is_a_typed_keyword_and_documented():
    names = {field.name for field in dataclasses.fields(MultiresControls)}
    assert names == MultiresControlArguments.__optional_keys__
    assert names == field_docs(MultiresControls).keys()


def test_unknown_controls_are_refused_with_the_nearest_name():
    model = gk.load("demo")
    for call in (model.generate, model.check_controls):
        with pytest.raises(UnknownControlError, match="no control keyfram; did you mean keyframes"):
            call(keyfram="clip.bvh")
        with pytest.raises(UnknownControlError, match="multires models have no control guidance"):
            call(guidance=2.0)
    model.check_controls(events=None, guidance=None, levels=2)
