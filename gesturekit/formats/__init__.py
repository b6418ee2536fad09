"""Readers and writers of motion files: BVH, npz, glTF, FBX, SMPL rigs, EasyMocap, meshes."""

from gesturekit.formats.bvh.bvh import read_bvh, write_bvh
from gesturekit.formats.fbx import read_fbx
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.formats.npz import read_npz, write_npz
from gesturekit.formats.obj import write_obj
from gesturekit.formats.smpl.easymocap import read_easymocap

__all__ = [
    "read_bvh",
    "read_easymocap",
    "read_fbx",
    "read_gltf",
    "read_npz",
    "write_bvh",
    "write_npz",
    "write_obj",
]
