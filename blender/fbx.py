"""Convert between glTF and FBX; run by Blender, or by a Python that has its module `bpy`.

    blender --background --python fbx.py -- IN.glb OUT.fbx FPS    with a key at each frame of RATE
    python fbx.py IN.fbx OUT.glb                                  writes the rate to OUT.txt

Frames are passed by their numbers, since Blender's importer and exporter of glTF take rates that
are no whole numbers for others.
"""

from __future__ import annotations

import math
import os
import sys
from pathlib import Path

import bpy

RATE = 30
"""Frames per second within glTF files."""
NEARLY = 0.01


def to_fbx(source: str, target: str, fps: float) -> None:
    """Write an FBX file of a .glb file with a key at each frame of `RATE`."""
    scene = bpy.context.scene
    scene.render.fps, scene.render.fps_base = RATE, 1.0
    # Other heuristics turn bones until their Euler angles lock, which costs 0.2 degrees.
    options = {"bone_heuristic": "BLENDER"}
    if "disable_bone_shape" in bpy.ops.import_scene.gltf.get_rna_type().properties:
        options["disable_bone_shape"] = True  # a mesh that would be exported too
    bpy.ops.import_scene.gltf(filepath=source, **options)
    scene.render.fps = max(1, math.ceil(fps))
    scene.render.fps_base = scene.render.fps / fps
    ends = [round(action.frame_range[1]) for action in bpy.data.actions]
    scene.frame_start, scene.frame_end = 0, max(ends, default=0)
    bpy.ops.export_scene.fbx(
        filepath=target,
        object_types={"ARMATURE", "MESH", "EMPTY"},
        add_leaf_bones=False,
        use_custom_props=True,
        bake_anim_use_nla_strips=False,
        bake_anim_use_all_actions=False,
        bake_anim_simplify_factor=0.0,
        path_mode="COPY",
        embed_textures=True,
    )


def keys_at_frames(action: bpy.types.Action) -> None:
    """Move keys that are nearly a frame apart to frames, as at 29.97 frames per second."""
    curves = [curve.keyframe_points for curve in action.fcurves]
    longest = max(curves, key=len, default=())
    if len(longest) < 2:
        return
    first = longest[0].co.x
    step = (longest[-1].co.x - first) / (len(longest) - 1)
    if abs(step - 1) > NEARLY:
        return
    for keys in curves:
        for key in keys:
            key.co.x = key.handle_left.x = key.handle_right.x = round((key.co.x - first) / step)


def to_gltf(source: str, target: str) -> None:
    """Write a .glb file of an FBX file, with a key at each frame of `RATE`."""
    bpy.ops.import_scene.fbx(filepath=source)
    for action in bpy.data.actions:
        keys_at_frames(action)
    render = bpy.context.scene.render
    Path(target).with_suffix(".txt").write_text(repr(render.fps / render.fps_base))
    render.fps, render.fps_base = RATE, 1.0
    bpy.ops.export_scene.gltf(
        filepath=target,
        export_extras=True,
        export_optimize_animation_size=False,
    )


arguments = sys.argv[sys.argv.index("--") + 1 :] if "--" in sys.argv else sys.argv[1:]
bpy.ops.wm.read_factory_settings(use_empty=True)
if arguments[0].lower().endswith(".glb"):
    to_fbx(arguments[0], arguments[1], float(arguments[2]))
else:
    to_gltf(arguments[0], arguments[1])
sys.stdout.flush()
os._exit(0)  # bpy 4.2 crashes while Python clears up
