"""Imports and help are fast, and every example in the help and on the pages works."""

import ast
import importlib
import inspect
import subprocess
import sys
import typing
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
HEAVY = ("torch", "librosa", "transformers", "scipy.signal", "matplotlib")


HELP = """
import sys
from gesturekit.cli import VERBS, main
for verb in ("--help", *VERBS):
    try:
        main([verb] if verb == "--help" else [verb, "--help"])
    except SystemExit:
        assert not heavy & sys.modules.keys(), verb
"""


@pytest.mark.parametrize(
    "code",
    ["from gesturekit import GestureKitError; from audio_features import AudioError", HELP],
    ids=["import", "help"],
)
def test_nothing_heavy_is_loaded(code):
    code = f"heavy = set({HEAVY})\n{code}\nimport sys\nprint('loaded', *heavy & sys.modules.keys())"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout.splitlines()[-1] == "loaded"


def test_public_names_are_there():
    import audio_features as af
    import gesturekit as gk

    for package in (gk, af):
        for name in package.__all__:
            assert getattr(package, name) is not None
        assert set(dir(package)) - {"__version__"} == set(package.__all__)
        assert (Path(package.__file__).parent / "py.typed").is_file()
        with pytest.raises(AttributeError, match="no_such_name"):
            _ = package.no_such_name


def test_type_checkers_see_what_is_exported():
    """Names under TYPE_CHECKING are those that are imported on demand."""
    import gesturekit as gk

    tree = ast.parse(Path(gk.__file__).read_text(encoding="utf-8"))
    (block,) = (node for node in tree.body if isinstance(node, ast.If))
    seen = {alias.name for node in block.body for alias in node.names}
    assert seen == set(gk.__all__)


@pytest.mark.parametrize("system", ["multires", "diffusion"])
def test_models_of_every_system_implement_the_model_protocol(system):
    import gesturekit as gk
    from gesturekit.systems import SYSTEMS

    module, _, name = SYSTEMS[system]["model"].partition(":")
    own = inspect.signature(getattr(importlib.import_module(module), name).generate).parameters
    for promised in typing.get_overloads(gk.Model.generate):
        for name, parameter in inspect.signature(promised).parameters.items():
            if name == "controls":
                continue
            assert own[name].kind == parameter.kind, name
            assert parameter.default in (own[name].default, parameter.empty), name
