"""FBX files, which Blender converts from and to glTF in a process of its own.

The format has no open description, and no library on PyPI writes it.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import warnings
from collections.abc import Callable
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

from audio_features.atomic import atomic_write
from gesturekit.errors import FormatError
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.motion.motion import Motion
from gesturekit.wording import printable

PROGRAM = "GESTUREKIT_BLENDER"
"""Environment variable that names a `blender` program, or a Python with the module `bpy`."""
_SCRIPT = "blender/fbx.py"
_RATE = 30
"""Frames per second of .glb files for the script, which counts frames."""
_SECONDS = 1800
"""Time after which Blender is stopped."""


def read_fbx(
    path: str | os.PathLike[str],
    *,
    animation: str | None = None,
    unit: str = "m",
    up: str = "y",
    forward: str = "auto",
    fps: float | None = None,
) -> Motion:
    """Read an FBX file by Blender; arguments, result, warnings and errors as for `read_gltf`.

    Raises:
        FormatError: Blender is not found, or it failed.
    """
    path = Path(path)
    with tempfile.TemporaryDirectory() as folder:
        glb = Path(folder) / f"{path.stem}.glb"
        _blender(path, path.absolute(), glb)
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            try:
                motion = read_gltf(glb, animation=animation, unit=unit, up=up, forward=forward)
            except FormatError as error:
                raise FormatError(str(error).replace(str(glb), str(path))) from None
        for warning in caught:
            warnings.warn(str(warning.message).replace(str(glb), str(path)), stacklevel=2)
        rate = float(glb.with_suffix(".txt").read_text("utf-8"))
    motion = replace(motion, fps=rate, info=motion.info | {"source": str(path)})
    return motion if fps is None else motion.resample(fps)


def write_by_blender(
    path: str | os.PathLike[str], motion: Motion, write_glb: Callable[[Motion, Path], None]
) -> None:
    """Write an FBX file of the .glb file that a function writes of a motion.

    Raises:
        FormatError: Blender is not found, or it failed.
    """
    blender_command(Path(path))
    with tempfile.TemporaryDirectory() as folder:
        glb, fbx = (Path(folder) / f"{Path(path).stem}{suffix}" for suffix in (".glb", ".fbx"))
        write_glb(replace(motion, fps=_RATE), glb)
        _blender(Path(path), glb, fbx, repr(motion.fps))
        with atomic_write(path) as temporary:
            shutil.copyfile(fbx, temporary)


def blender_command(path: Path) -> list[str]:
    """Return the command that runs the script in Blender.

    Raises:
        FormatError: neither program nor module was found.
    """
    # In a wheel it lies in the package, in a checkout beside it.
    here = Path(__file__).parents[1]
    script = here / _SCRIPT if (here / _SCRIPT).exists() else here.parent / _SCRIPT
    program = os.environ.get(PROGRAM) or shutil.which("blender")
    if not program and find_spec("bpy"):
        program = sys.executable
    if not program:
        how = f"install it, name it by {PROGRAM}=/path/to/blender, or use glb"
        raise FormatError(f"{path}: FBX needs Blender (`blender` or `bpy`), not found: {how}")
    if Path(program).name.startswith("python"):
        return [program, str(script)]
    options = ["--background", "--factory-startup", "--python-exit-code", "1", "--python"]
    return [program, *options, str(script), "--"]


def _blender(path: Path, *arguments: str | Path) -> None:
    """Run the script, which writes the second argument, a file, from the first."""
    made = Path(arguments[1])
    try:
        done = subprocess.run(
            [*blender_command(path), *map(str, arguments)],
            capture_output=True,
            errors="replace",
            timeout=_SECONDS,
            check=False,
        )
        said = printable((done.stderr.strip() or done.stdout.strip()).rpartition("\n")[2])
    except (OSError, subprocess.TimeoutExpired) as error:
        said = str(error)
    if not made.exists():
        raise FormatError(f"{path}: Blender did not convert it: {said[-300:]}")
