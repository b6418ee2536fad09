"""Joints and faces that Blender reads from BVH, glTF and FBX; run by the Python that has `bpy`.

python blender_positions.py FILE ...    writes FILE.blender.json beside each
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import bpy


def load(path: Path) -> range:
    """Import a file; return its frames."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    if path.suffix == ".bvh":
        scene.frame_end = 1  # a longer scene would keep its length
        bpy.ops.import_anim.bvh(
            filepath=str(path),
            axis_forward="-Z",
            axis_up="Y",
            rotate_mode="NATIVE",
            update_scene_fps=True,
            update_scene_duration=True,
        )
        return range(1, scene.frame_end)  # it makes room for one more than there are
    if path.suffix == ".fbx":
        bpy.ops.import_scene.fbx(filepath=str(path))
    else:
        scene.render.fps = 30  # of the files of interop.py; the format has none
        bpy.ops.import_scene.gltf(filepath=str(path), bone_heuristic="TEMPERANCE")
    ranges = [action.frame_range for action in bpy.data.actions]
    return range(round(min(r[0] for r in ranges)), round(max(r[1] for r in ranges)) + 1)


def positions(path: Path) -> dict[str, object]:
    """Rate, frames, face and joints, in the file's axes: Blender's world is (x, -z, y) of them."""
    numbers = load(path)
    scene = bpy.context.scene
    armature = next(thing for thing in scene.objects if thing.type == "ARMATURE")
    with_keys = [thing.data.shape_keys for thing in scene.objects if thing.type == "MESH"]
    blocks = [block for keys in with_keys if keys for block in list(keys.key_blocks)[1:]]
    face = {block.name: [] for block in blocks}
    frames = []
    for frame in numbers:
        scene.frame_set(frame)
        heads = [armature.matrix_world @ bone.head for bone in armature.pose.bones]
        frames.append([[x, z, -y] for x, y, z in heads])
        for block in blocks:
            face[block.name].append(block.value)
    names = [bone.name for bone in armature.pose.bones]
    fps = scene.render.fps / scene.render.fps_base
    return {"fps": fps, "names": names, "frames": frames, "face": face}


for name in sys.argv[1:]:
    Path(name + ".blender.json").write_text(json.dumps(positions(Path(name))))
sys.stdout.flush()
os._exit(0)  # bpy 4.2 crashes while Python clears up
