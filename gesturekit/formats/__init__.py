"""Readers and writers of motion files: BVH, npz, glTF, FBX, SMPL rigs, EasyMocap, meshes."""

from gesturekit.formats.bvh import read_bvh, write_bvh
from gesturekit.formats.easymocap import read_easymocap
from gesturekit.formats.fbx import read_fbx
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.formats.npz import read_npz, write_npz
from gesturekit.formats.smpl import write_obj
from gesturekit.lazy import attach, by_name

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

_OTHERS = {
    "gltf.file": "Gltf",
    "gltf.skin": "Skin whole_weights",
    "gltf.vrm": "avatar_facts our_names read_avatar",
    "npz": "frames_header frames_rows",
    "plausibility": "METRES guess_unit plausibility_warnings",
    "smpl": "Rig fit_body mean_body model_pelvis smpl_skeleton",
    "sources": "motions_in visible_folders",
    "tables": "Event load_events load_root_path load_semantics",
}
__getattr__ = attach(__name__, {}, by_name(_OTHERS))[1]
