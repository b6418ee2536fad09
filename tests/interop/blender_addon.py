"""Joint positions that the Blender add-on gives motion files; run by the Python that has `bpy`.

python blender_addon.py ADDON.zip FILE ...    writes FILE.addon.json and FILE.rig.json beside each
"""

from __future__ import annotations

import json
import math
import os
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

HEADING, PLACE = 0.5, (1.0, 2.0, 0.0)


def positions() -> dict[str, object]:
    """Rate, sound, and joints relative to the place of the active armature, metres, Y up."""
    scene, armature = bpy.context.scene, bpy.context.object
    frames = []
    for frame in range(scene.frame_start, scene.frame_end + 1):
        scene.frame_set(frame)
        turned = Matrix.Rotation(-armature.rotation_euler.z, 4, "Z")
        inward = turned @ Matrix.Translation(-armature.location) @ armature.matrix_world
        heads = [inward @ bone.head for bone in armature.pose.bones]
        frames.append([[x, z, -y] for x, y, z in heads])
    editor = scene.sequence_editor
    strips = getattr(editor, "strips", None) or getattr(editor, "sequences", ())
    found = [[Path(strip.sound.filepath).name, strip.frame_start] for strip in strips]
    return {
        "fps": scene.render.fps / scene.render.fps_base,
        "names": [bone.name for bone in armature.pose.bones],
        "frames": frames,
        "sound": found if bpy.app.build_options.audaspace else None,
    }


def another_rig() -> None:
    """Make it a rig of centimetres that lies on its back, in an object that puts it upright."""
    armature = bpy.context.object
    armature.animation_data_clear()
    bpy.ops.object.mode_set(mode="EDIT")
    for number, bone in enumerate(armature.data.edit_bones):
        bone.transform(Matrix.Rotation(-math.pi / 2, 4, "X") @ Matrix.Scale(100, 4))
        bone.roll += 0.3 + 0.1 * number
    bpy.ops.object.mode_set(mode="OBJECT")
    armature.scale = (0.01, 0.01, 0.01)
    armature.rotation_euler = (math.pi / 2, 0, HEADING)
    armature.location = PLACE
    bpy.context.view_layer.update()


addon, *names = sys.argv[1:]
bpy.ops.preferences.addon_install(filepath=addon, overwrite=True)
bpy.ops.preferences.addon_enable(module="gesturekit_motion")
for name in names:
    path = Path(name)
    for scene in bpy.data.scenes:
        scene.sequence_editor_clear()
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.ops.import_anim.gesturekit(filepath=name)
    path.with_name(path.name + ".addon.json").write_text(json.dumps(positions()))
    another_rig()
    bpy.ops.import_anim.gesturekit(filepath=name, onto_active=True)
    path.with_name(path.name + ".rig.json").write_text(json.dumps(positions()))
sys.stdout.flush()
os._exit(0)  # bpy 4.2 crashes while Python clears up
