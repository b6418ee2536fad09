"""Blender add-on: import motion of gesturekit with its sound, as an armature or onto one."""

from __future__ import annotations

from pathlib import Path

import bpy
import numpy as np
from bpy.props import BoolProperty, StringProperty
from bpy_extras.io_utils import ImportHelper
from mathutils import Matrix, Vector

from .reading import Clip, read_clip

bl_info = {
    "name": "gesturekit motion",
    "author": "gesturekit",
    "version": (1, 0, 0),
    "blender": (3, 4, 0),
    "location": "File > Import > gesturekit motion",
    "description": "Import .bvh and .npz motion with its sound at the right rate, scale and axes",
    "category": "Import-Export",
}

_FIRST = 1  # frame of the scene that shows frame 0 of the motion
_SHORTEST = 0.01  # metres; Blender removes bones without a length
_TO_BLENDER = Matrix(((1, 0, 0), (0, 0, -1), (0, 1, 0)))  # Y up to Z up


class GESTUREKIT_OT_import(bpy.types.Operator, ImportHelper):
    """Import a motion of gesturekit (.bvh, .npz) with its sound"""

    bl_idname = "import_anim.gesturekit"
    bl_label = "Import gesturekit motion"
    bl_options = {"REGISTER", "UNDO"}
    filter_glob: StringProperty(default="*.bvh;*.npz", options={"HIDDEN"})
    sound: StringProperty(
        name="Sound",
        description="Sound file. Empty takes the wav of the same name beside the motion, if any",
        subtype="FILE_PATH",
    )
    onto_active: BoolProperty(
        name="Onto the active armature",
        description="Animate the bones of the active armature that have the joints' names",
    )

    def execute(self, context):
        """Import the file; errors are reported and leave the scene as it is."""
        rig = context.active_object if self.onto_active else None
        sound = self.sound and bpy.path.abspath(self.sound)
        try:
            if self.onto_active and (rig is None or rig.type != "ARMATURE"):
                raise ValueError("no active armature: select yours first")
            if sound and not Path(sound).is_file():
                raise ValueError(f"{sound}: no such sound file")
            clip = read_clip(self.filepath)
            animate(context, clip, Path(self.filepath).stem, rig)
        except ValueError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        set_time(context.scene, clip)
        beside = Path(self.filepath).with_suffix(".wav")
        if sound or beside.is_file():
            try:
                add_sound(context.scene, sound or str(beside))
            except RuntimeError as error:  # builds without sound, Blender's Python module 4.2
                self.report({"WARNING"}, f"The motion is imported without its sound: {error}")
        return {"FINISHED"}


def animate(context, clip: Clip, name: str, rig=None):
    """Put a motion on an armature, a new one if `rig` is None, and return it.

    Raises ValueError if no bone of `rig` has the name of a joint.
    """
    if rig is None:
        rig = build_armature(context, clip, name)
    own = {bone.name.replace(" ", "_"): bone for bone in rig.pose.bones}
    bones = [own.get(joint.replace(" ", "_")) for joint in clip.names]
    if not any(bones):
        raise ValueError(
            f"no bone of {rig.name} is named as a joint ({', '.join(clip.names[:5])}, …): "
            "retarget first, with gesturekit convert --rig"
        )
    animation = rig.animation_data_create()
    animation.action = bpy.data.actions.new(name)
    frames = np.arange(_FIRST, _FIRST + len(clip.rotations))
    # The armature's own axes and scale; the motion is relative to its place and heading.
    tilt = rig.matrix_world.to_euler("XYZ")
    tilt.z = 0
    axes = tilt.to_matrix().inverted() @ _TO_BLENDER
    turn = np.array(axes.to_quaternion())[[1, 2, 3, 0]]
    place = np.array(axes) / np.array(rig.matrix_world.to_scale())[:, None]
    for joint, bone in enumerate(bones):
        if bone is None:
            continue
        rest = bone.bone.matrix_local.to_3x3()
        inward = np.array(rest.inverted().to_quaternion())[[1, 2, 3, 0]]
        frame = _product(inward, turn)
        local = _product(_product(frame, clip.rotations[:, joint]), frame * [-1, -1, -1, 1])
        flips = (local[1:] * local[:-1]).sum(axis=1) < 0
        local[1:][np.cumsum(flips) % 2 == 1] *= -1  # the short way between frames
        bone.rotation_mode = "QUATERNION"
        _write(rig, bone, "rotation_quaternion", frames, local[:, [3, 0, 1, 2]])
        if joint in clip.places:
            moved = clip.places[joint]
            if clip.parents[joint] < 0:
                at = moved @ place.T - np.array(bone.bone.head_local)
            else:
                at = (moved - clip.offsets[joint]) @ place.T
            _write(rig, bone, "location", frames, at @ np.array(rest))
    return rig


def build_armature(context, clip: Clip, name: str):
    """Return a new armature with the joints at rest as the heads of its bones."""
    if context.object and context.object.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    rig = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    context.collection.objects.link(rig)
    bpy.ops.object.select_all(action="DESELECT")
    rig.select_set(True)
    context.view_layer.objects.active = rig
    bpy.ops.object.mode_set(mode="EDIT")
    heads, made = [], []
    for joint, parent in enumerate(clip.parents):
        bone = rig.data.edit_bones.new(clip.names[joint])
        clip.names[joint] = bone.name  # Blender cuts long names and renames doubles
        offset = _TO_BLENDER @ Vector(clip.offsets[joint])
        heads.append(offset + heads[parent] if parent >= 0 else offset)
        made.append(bone)
        bone.head = heads[-1]
        if parent >= 0:
            bone.parent = made[parent]
    for joint, bone in enumerate(made):
        children = [clip.offsets[k] for k, p in enumerate(clip.parents) if p == joint]
        ends = children or ([clip.ends[joint]] if clip.ends[joint] is not None else [])
        along = Vector(max(ends, key=np.linalg.norm)) if ends else Vector((0, 0, 0))
        if along.length < _SHORTEST:
            along = Vector((0, _SHORTEST, 0))
        bone.tail = bone.head + _TO_BLENDER @ along
    bpy.ops.object.mode_set(mode="OBJECT")
    return rig


def set_time(scene, clip: Clip) -> None:
    """Set the scene's frame rate and length."""
    scene.render.fps = max(1, round(clip.fps))
    scene.render.fps_base = scene.render.fps / clip.fps
    scene.frame_start, scene.frame_end = _FIRST, _FIRST + len(clip.rotations) - 1


def add_sound(scene, path: str) -> None:
    """Put a sound where the motion begins, and play the scene in time with it."""
    editor = scene.sequence_editor_create()
    strips = editor.strips if hasattr(editor, "strips") else editor.sequences  # before 4.4
    sounds = [strip for strip in strips if strip.type == "SOUND"]
    # A second body to the same speech needs no second sound.
    if (_FIRST, path) not in [(strip.frame_start, strip.sound.filepath) for strip in sounds]:
        channel = 1 + max((strip.channel for strip in strips), default=0)
        strips.new_sound(Path(path).stem, path, channel, _FIRST)
    scene.sync_mode = "AUDIO_SYNC"


def _write(rig, bone, what: str, frames: np.ndarray, values: np.ndarray) -> None:
    action, path = rig.animation_data.action, f"{bone.path_from_id()}.{what}"
    for index, column in enumerate(values.T):
        if hasattr(action, "fcurve_ensure_for_datablock"):  # Blender 5
            curve = action.fcurve_ensure_for_datablock(rig, path, index=index)
        else:
            curve = action.fcurves.new(path, index=index, action_group=bone.name)
        curve.keyframe_points.add(len(frames))
        curve.keyframe_points.foreach_set("co", np.stack([frames, column], axis=1).ravel())
        linear = np.ones(len(frames), np.int32)  # LINEAR of Keyframe.interpolation
        curve.keyframe_points.foreach_set("interpolation", linear)
        curve.update()


def _product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the product of quaternions xyzw, first b, then a."""
    a, b = np.broadcast_arrays(np.atleast_2d(a), np.atleast_2d(b))
    vector = a[:, 3:] * b[:, :3] + b[:, 3:] * a[:, :3] + np.cross(a[:, :3], b[:, :3])
    scalar = a[:, 3] * b[:, 3] - (a[:, :3] * b[:, :3]).sum(axis=1)
    return np.concatenate([vector, scalar[:, None]], axis=1)


def _menu(self, context):
    self.layout.operator(GESTUREKIT_OT_import.bl_idname, text="gesturekit motion (.bvh, .npz)")


def register():
    """Add the operator to File > Import."""
    bpy.utils.register_class(GESTUREKIT_OT_import)
    bpy.types.TOPBAR_MT_file_import.append(_menu)


def unregister():
    """Remove it again."""
    bpy.types.TOPBAR_MT_file_import.remove(_menu)
    bpy.utils.unregister_class(GESTUREKIT_OT_import)
