"""Readers and writers of motion files: BVH, npz, glTF, FBX, SMPL rigs, EasyMocap, meshes."""

from gesturekit.formats.bvh.bvh import read_bvh, write_bvh
from gesturekit.formats.fbx import read_fbx
from gesturekit.formats.frames import frames_header, frames_rows
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.reading import read_gltf
from gesturekit.formats.gltf.skin import Skin, whole_weights
from gesturekit.formats.gltf.vrm import avatar_facts, our_names, read_avatar
from gesturekit.formats.npz import read_npz, write_npz
from gesturekit.formats.obj import write_obj
from gesturekit.formats.plausibility import METRES, guess_unit, plausibility_warnings
from gesturekit.formats.rig import Rig
from gesturekit.formats.smpl.easymocap import read_easymocap
from gesturekit.formats.smpl.skeleton import fit_body, mean_body, model_pelvis, smpl_skeleton
from gesturekit.formats.sources import motions_in, visible_folders
from gesturekit.formats.tables.events import Event, load_events
from gesturekit.formats.tables.root_path import load_root_path
from gesturekit.formats.tables.semantics import load_semantics

__all__ = [
    "Event",
    "Gltf",
    "METRES",
    "Rig",
    "Skin",
    "avatar_facts",
    "fit_body",
    "frames_header",
    "frames_rows",
    "guess_unit",
    "load_events",
    "load_root_path",
    "load_semantics",
    "mean_body",
    "model_pelvis",
    "motions_in",
    "our_names",
    "plausibility_warnings",
    "read_avatar",
    "read_bvh",
    "read_easymocap",
    "read_fbx",
    "read_gltf",
    "read_npz",
    "smpl_skeleton",
    "visible_folders",
    "whole_weights",
    "write_bvh",
    "write_npz",
    "write_obj",
]
