"""The Blender add-on reads our motion files as gesturekit does; what Blender makes of them is
checked by `make interop`."""

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from gesturekit.motion import Motion

ROOT = Path(__file__).resolve().parents[2]


def script(path: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"addon_test_{Path(path).stem}", ROOT / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def reading() -> ModuleType:
    return script("blender/gesturekit_motion/reading.py")


@pytest.fixture(scope="module")
def odd_motion() -> Motion:
    return script("tests/interop/interop.py").odd_motion()


@pytest.mark.filterwarnings("ignore:joint names with spaces")
@pytest.mark.parametrize("suffix", ["bvh", "npz"])
def test_joints_rotations_and_places_are_those_of_the_file(reading, odd_motion, suffix, tmp_path):
    path = tmp_path / f"odd.{suffix}"
    odd_motion.save(path)
    ours = Motion.load(path)
    clip = reading.read_clip(str(path))
    assert tuple(clip.names) == ours.skeleton.names
    assert clip.parents == list(ours.skeleton.parents)
    still = [j for j, name in enumerate(clip.names) if name not in ours.joint_translations]
    np.testing.assert_allclose(clip.offsets[still], ours.skeleton.offsets[still], atol=1e-8)
    agreement = np.abs((clip.rotations * ours.rotations).sum(axis=-1))
    np.testing.assert_allclose(agreement, 1, atol=1e-9)
    np.testing.assert_allclose(clip.places.pop(0), ours.translation, atol=1e-8)
    moving = {clip.names[joint]: place for joint, place in clip.places.items()}
    assert moving.keys() == ours.joint_translations.keys()
    for name, place in moving.items():
        np.testing.assert_allclose(place, ours.joint_translations[name], atol=1e-8)
    np.testing.assert_allclose(clip.ends[clip.names.index("bone39")], [0, 0.05, 0], atol=1e-8)
    assert clip.fps == pytest.approx(30000 / 1001, rel=1e-7)


def test_other_files_are_named(reading, odd_motion, tmp_path):
    motion = odd_motion[:3]
    with pytest.warns(UserWarning, match="spaces"):
        motion.save(tmp_path / "a.bvh")
    text = (tmp_path / "a.bvh").read_text()
    (tmp_path / "short.bvh").write_text(text[: len(text) - 2000])
    (tmp_path / "none.bvh").write_text("HIERARCHY")
    np.savez(tmp_path / "other.npz", poses=np.zeros((2, 3)))
    np.savez(tmp_path / "objects.npz", names=np.array([{}], object))
    for name in ("short.bvh", "none.bvh", "other.npz", "objects.npz", "missing.bvh"):
        with pytest.raises(ValueError, match=f"(?=.*{name})(?=.*motion)"):
            reading.read_clip(str(tmp_path / name))
