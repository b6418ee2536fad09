"""Where Blender puts the joints of BVH files; run by the Python that has `bpy`.

python blender_positions.py FILE.bvh ...    writes FILE.blender.json beside each
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path

import bpy


def positions(path: Path) -> dict[str, object]:
    """Rate, frames and joints, in the BVH file's own axes and unit."""
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.scene.frame_end = 1  # a longer scene would keep its length
    bpy.ops.import_anim.bvh(
        filepath=str(path),
        axis_forward="-Z",
        axis_up="Y",
        rotate_mode="NATIVE",
        update_scene_fps=True,
        update_scene_duration=True,
    )
    scene, armature = bpy.context.scene, bpy.context.object
    frames = []
    for frame in range(1, scene.frame_end):  # it makes room for one more than there are
        scene.frame_set(frame)
        heads = [armature.matrix_world @ bone.head for bone in armature.pose.bones]
        frames.append([[x, z, -y] for x, y, z in heads])  # Blender's world is the file's (x, -z, y)
    names = [bone.name for bone in armature.pose.bones]
    return {"fps": scene.render.fps / scene.render.fps_base, "names": names, "frames": frames}


for name in sys.argv[1:]:
    path = Path(name)
    path.with_suffix(".blender.json").write_text(json.dumps(positions(path)))
sys.stdout.flush()
os._exit(0)  # bpy 4.2 crashes while Python clears up
