"""Readers and writers of motion files: BVH, npz, glTF, FBX, SMPL rigs, EasyMocap, meshes."""

from gesturekit.formats.bvh.bvh import read_bvh, write_bvh
from gesturekit.formats.fbx import read_fbx
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.formats.npz import read_npz, write_npz
from gesturekit.formats.obj import write_obj
from gesturekit.formats.smpl.easymocap import read_easymocap
from gesturekit.lazy import attach

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

__getattr__ = attach(
    __name__,
    {},
    {
        "Event": "tables.events",
        "Gltf": "gltf.file",
        "METRES": "plausibility",
        "Rig": "rig",
        "Skin": "gltf.skin",
        "avatar_facts": "gltf.vrm",
        "fit_body": "smpl.skeleton",
        "frames_header": "frames",
        "frames_rows": "frames",
        "guess_unit": "plausibility",
        "load_events": "tables.events",
        "load_root_path": "tables.root_path",
        "load_semantics": "tables.semantics",
        "mean_body": "smpl.skeleton",
        "model_pelvis": "smpl.skeleton",
        "motions_in": "sources",
        "our_names": "gltf.vrm",
        "plausibility_warnings": "plausibility",
        "read_avatar": "gltf.vrm",
        "smpl_skeleton": "smpl.skeleton",
        "visible_folders": "sources",
        "whole_weights": "gltf.skin",
    },
)[1]
