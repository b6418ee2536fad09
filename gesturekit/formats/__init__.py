"""Readers and writers of motion files: BVH, npz, glTF, FBX, SMPL rigs, EasyMocap, meshes, faces."""

from gesturekit.formats.bvh import read_bvh, write_bvh
from gesturekit.formats.easymocap import read_easymocap
from gesturekit.formats.fbx import read_fbx
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.formats.live_link import read_live_link, write_live_link
from gesturekit.formats.npz import read_npz, write_npz
from gesturekit.formats.smpl import write_obj

__all__ = [
    "read_bvh",
    "read_easymocap",
    "read_fbx",
    "read_gltf",
    "read_live_link",
    "read_npz",
    "write_bvh",
    "write_live_link",
    "write_npz",
    "write_obj",
]
