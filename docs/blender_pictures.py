"""Screenshots of docs/blender.md, taken in Blender's window (without a display: under xvfb-run).

    make blender && gesturekit demo --out build
    blender --window-geometry 0 0 1280 720 --python docs/blender_pictures.py -- docs build
    gesturekit convert build/speech.bvh build/mine.bvh --rig build/exported.bvh
    blender --window-geometry 0 0 1280 720 --python docs/blender_pictures.py -- docs build

The first time shows windows and writes the rig to retarget to, the second time shows motions.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import bpy

FRAME = 100
PICTURES, BUILD = (Path(name).resolve() for name in sys.argv[sys.argv.index("--") + 1 :])


def screenshot(name: str, window: bpy.types.Window) -> None:
    """Write NAME.webp."""
    with tempfile.TemporaryDirectory() as folder:
        picture = str(Path(folder, "picture.png"))
        with bpy.context.temp_override(window=window):
            bpy.ops.screen.screenshot(filepath=picture)
        image = bpy.data.images.load(picture)
        scene = bpy.context.scene
        scene.view_settings.view_transform = "Standard"
        scene.render.image_settings.file_format = "WEBP"
        scene.render.image_settings.quality = 80
        image.save_render(str(PICTURES / f"{name}.webp"))
        bpy.data.images.remove(image)


def area(kind: str) -> bpy.types.Area:
    """Return the area of the main window with this editor."""
    return next(one for one in main_window().screen.areas if one.ui_type == kind)


def main_window() -> bpy.types.Window:
    """Return the first window."""
    return bpy.context.window_manager.windows[0]


def look(distance: float) -> None:
    """Look at the armature from its front and side."""
    region = area("VIEW_3D").spaces.active.region_3d
    region.view_distance, region.view_location = distance, (0, 0, 0.95)
    region.view_rotation = (0.757, 0.632, 0.107, 0.128)


def clear() -> None:
    """Remove all objects and sounds."""
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    bpy.context.scene.sequence_editor_clear()


def split_off_sequencer() -> None:
    """Give the lower part of the 3D view to the video sequencer."""
    view = area("VIEW_3D")
    region = next(one for one in view.regions if one.type == "WINDOW")
    with bpy.context.temp_override(window=main_window(), area=view, region=region):
        bpy.ops.screen.area_split(direction="HORIZONTAL", factor=0.2)
    lowest = min(
        (a for a in main_window().screen.areas if a.ui_type == "VIEW_3D"), key=lambda a: a.y
    )
    lowest.ui_type = "SEQUENCE_EDITOR"


def own_rig() -> bpy.types.Object:
    """Return a new armature of a human, active: Rigify's."""
    with bpy.context.temp_override(window=main_window()):
        bpy.ops.object.armature_human_metarig_add()
        bpy.ops.object.mode_set(mode="OBJECT")
        return bpy.context.object


def take_windows(motion: Path) -> Iterator[float]:
    """Take the screenshots of the preferences and of the import; write exported.bvh."""
    bpy.context.preferences.active_section = "ADDONS"
    bpy.context.window_manager.addon_search = "gesturekit"
    bpy.ops.screen.userpref_show()
    yield 3
    screenshot("blender_addon", bpy.context.window_manager.windows[-1])
    with bpy.context.temp_override(window=bpy.context.window_manager.windows[-1]):
        bpy.ops.wm.window_close()
    yield 1
    with bpy.context.temp_override(window=main_window()):
        bpy.ops.import_anim.gesturekit("INVOKE_DEFAULT", filepath=str(motion))
    yield 3
    screenshot("blender_import", bpy.context.window_manager.windows[-1])
    own_rig()
    with bpy.context.temp_override(window=main_window()):
        bpy.ops.export_anim.bvh(filepath=str(BUILD / "exported.bvh"), frame_start=1, frame_end=1)


def take_motions(motion: Path, retargeted: Path) -> Iterator[float]:
    """Take the screenshots of an imported motion and of the rig that wears it."""
    split_off_sequencer()
    for name, file in (("blender_motion", motion), ("blender_rig", retargeted)):
        clear()
        if file == retargeted:
            own_rig()
        with bpy.context.temp_override(window=main_window()):
            bpy.ops.import_anim.gesturekit(
                filepath=str(file),
                sound=str(motion.with_suffix(".wav")),
                onto_active=file == retargeted,
            )
        bpy.context.scene.frame_set(FRAME)
        look(4.2)
        sequencer = area("SEQUENCE_EDITOR")
        region = next(one for one in sequencer.regions if one.type == "WINDOW")
        for strip in bpy.context.scene.sequence_editor.sequences:
            strip.show_waveform = True
        with bpy.context.temp_override(window=main_window(), area=sequencer, region=region):
            bpy.ops.sequencer.view_selected()
        yield 3
        screenshot(name, main_window())


def take() -> Iterator[float]:
    """Take screenshots; yields seconds to wait for windows to be drawn."""
    bpy.context.preferences.view.show_splash = False
    bpy.ops.preferences.addon_install(filepath=str(BUILD / "gesturekit_motion.zip"), overwrite=True)
    bpy.ops.preferences.addon_enable(module="gesturekit_motion")
    bpy.ops.preferences.addon_enable(module="rigify")
    clear()
    motion, retargeted = BUILD / "speech.bvh", BUILD / "mine.bvh"
    if retargeted.exists():
        yield from take_motions(motion, retargeted)
    else:
        yield from take_windows(motion)


def run(steps: Iterator[float]) -> None:
    """Run the steps one after another, then quit."""

    def step() -> float | None:
        try:
            return next(steps)
        except StopIteration:
            bpy.ops.wm.quit_blender()
            return None

    bpy.app.timers.register(step, first_interval=2)


run(take())
