"""Motions that a request gives: retargeting to a model's rig, clips to keep (in-betweening)."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from gesturekit.errors import ModelError, MotionError
from gesturekit.motion.contacts import floor_height
from gesturekit.motion.model_joints import ModelJoints
from gesturekit.motion.motion import Motion
from gesturekit.motion.parts import find_parts
from gesturekit.motion.resampling import smoothstep
from gesturekit.motion.retarget import retarget
from gesturekit.motion.retarget.body_frames import standing_pose
from gesturekit.motion.root_path import heading
from gesturekit.motion.rotations import slerp
from gesturekit.motion.skeleton import GROUND

BLEND = 0.4
"""Seconds over which generated motion is blended to the end of a clip."""
_AROUND_SECONDS = 60.0
"""Seconds before and after a pose that are retargeted with it."""


def on_rig(model: ModelJoints, motion: Motion) -> Motion:
    """Return the motion on the model's rig, retargeted if its own rig is different.

    Raises:
        ModelError: the motion cannot be retargeted.
    """
    rig = model.skeleton
    if (motion.skeleton.names, motion.skeleton.parents) == (rig.names, rig.parents):
        return motion
    mean = Motion(rig, model.fixed_rotations[None], np.zeros((1, 3)), 1.0)
    try:
        upright = standing_pose(mean)
    except MotionError:  # the mean training pose does not stand
        upright = None
    try:
        return retarget(motion, rig, pose=upright)
    except MotionError as error:
        raise ModelError(f"the motion cannot be retargeted to the model's rig: {error}") from None


def pose_on_rig(
    model: ModelJoints, read: Callable[[int], tuple[Motion, int]], default: int
) -> Motion:
    """Return a frame of a motion as a pose of the model's rig; arguments as for `Placement.of`.

    Of a motion on another rig, joints without a counterpart keep the pose that the model gives
    them, and `info["floor"]` is the height of its floor on the model's rig, metres.

    Raises:
        ModelError: the motion cannot be retargeted.
    """
    whole, frame = read(default)
    # Retargeting finds out how a rig stands, for which a minute before and after is enough.
    around = math.ceil(_AROUND_SECONDS * whole.fps)
    first = max(0, frame - around)
    motion, frame = whole[first : frame + around], frame - first
    retargeted = on_rig(model, motion)
    pose, given = (m[frame : frame + 1] for m in (retargeted, motion))
    if retargeted is motion:
        return pose
    source, target = (find_parts(m.skeleton) for m in (given, pose))
    rotations, translation = pose.rotations.copy(), pose.translation.copy()
    if not source.fingers:
        others = [j for j in range(model.skeleton.n_joints) if j not in model.indices]
        rotations[:, others] = model.fixed_rotations[others]
    # Retargeting scales the way from the first frame; a place in a scene has no scale.
    places = [
        m.positions()[:, m.skeleton.index(parts.pelvis)]
        for m, parts in ((given, source), (pose, target))
    ]
    translation[:, GROUND] += (places[0] - places[1])[:, GROUND]
    return replace(
        pose,
        rotations=rotations,
        translation=translation,
        info={"floor": floor_height(retargeted)},
    )


class InbetweenClips:
    """Given clips at fixed times of a motion, with their positions and headings in the world.

    Args:
        clips: motions by the second at which each begins; of the model's rig, or of another one,
            which is retargeted.
        rig: of the model.
        fps: frames per second.

    Raises:
        ModelError: no clips, clips that overlap, or one that cannot be retargeted.
    """

    def __init__(
        self, clips: Mapping[float, Motion | str | Path], rig: ModelJoints, fps: float
    ) -> None:
        self.rig, self.fps = rig, fps
        self.clips: list[tuple[int, Motion]] = []
        problem = "" if clips else "no motion is given"
        for second, clip in sorted(clips.items()):
            end = f"{self.end / fps:g} s"
            if not (math.isfinite(second) and second >= 0):
                problem = f"a clip begins at {second:g} s; expected 0 or later"
            elif (begin := math.floor(second * fps + 0.5)) < self.end:
                problem = f"the clip at {second:g} s begins before the one before it ends ({end})"
            if problem:
                break
            motion = clip if isinstance(clip, Motion) else Motion.load(clip)
            self.clips.append((begin, on_rig(rig, motion).resample(fps)))
        if problem:
            raise ModelError(f"keep: {problem}")
        # All clips are turned together, so that their mean heading is +Z as in training.
        each = [heading(clip) for _, clip in self.clips]
        weight = [clip.n_frames for _, clip in self.clips]
        self.heading = float(np.arctan2(np.sin(each) @ weight, np.cos(each) @ weight))

    @property
    def end(self) -> int:
        """The frame after the last clip."""
        return self.clips[-1][0] + self.clips[-1][1].n_frames if self.clips else 0

    def check_end(self, n_frames: int) -> None:
        """Raise ModelError if a clip ends after this many frames."""
        if self.end > n_frames:
            raise ModelError(
                f"keep: the last clip ends at {self.end / self.fps:g} s, after the motion's end "
                f"({n_frames / self.fps:g} s)"
            )

    def fastest_gap(self) -> float:
        """Return the highest mean speed (m/s) over the ground that a gap between clips needs."""
        speeds = [0.0]
        for (begin, clip), (after, other) in zip(self.clips, self.clips[1:], strict=False):
            way = ground_positions(self.rig, other)[0] - ground_positions(self.rig, clip)[-1]
            frames = after - begin - clip.n_frames + 1
            speeds.append(float(np.linalg.norm(way)) * self.fps / frames)
        return max(speeds)

    def given(self, n_frames: int) -> np.ndarray:
        """Return (T,) weights: 1 in the clips, falling to 0 beside them over `BLEND`."""
        weight = np.zeros(n_frames)
        fall = smoothstep(1 - _fractions(max(1, round(BLEND * self.fps))))
        for begin, clip in self.clips:
            stop = begin + clip.n_frames
            weight[begin:stop] = 1
            after = weight[stop : stop + len(fall)]
            before = weight[max(0, begin - len(fall)) : begin]
            np.maximum(after, fall[: len(after)], out=after)
            np.maximum(before, fall[::-1][len(fall) - len(before) :], out=before)
        return weight

    def restored(self, motion: Motion) -> Motion:
        """Return the motion with all joints of the clips, and their faces, as they were given.

        Joints that are not modelled are blended to those of the motion over `BLEND`.
        """
        rotations, translation = motion.rotations.copy(), motion.translation.copy()
        moving = {name: values.copy() for name, values in motion.joint_translations.items()}
        track = motion.face and replace(motion.face, values=motion.face.values.copy())
        skeleton = motion.skeleton
        modelled = {*self.rig.indices, *skeleton.ancestors(self.rig.root)}
        others = [j for j in range(skeleton.n_joints) if j not in modelled]
        inside = self.given(motion.n_frames) == 1
        for begin, clip in self.clips:
            stop = begin + clip.n_frames
            rotations[begin:stop], translation[begin:stop] = clip.rotations, clip.translation
            faces = None
            if track and clip.face and clip.face.names == track.names:
                if clip.face.origin == "rules":
                    track = replace(track, origin="rules")
                faces = track.values
                faces[begin:stop] = clip.face.values
            for name, values in moving.items():
                still = clip.skeleton.offsets[skeleton.index(name)]
                values[begin:stop] = clip.joint_translations.get(name, still)
            for edge, step in ((begin, -1), (stop - 1, 1)):
                for k, fraction in enumerate(_fractions(round(BLEND * self.fps)), 1):
                    frame = edge + step * k
                    if not 0 <= frame < motion.n_frames or inside[frame]:
                        break
                    if faces is not None:
                        faces[frame] += smoothstep(1 - fraction) * (faces[edge] - faces[frame])
                    rotations[frame, others] = slerp(
                        rotations[frame, others],
                        rotations[edge, others],
                        np.full(len(others), smoothstep(1 - fraction)),
                    )
        return replace(
            motion,
            rotations=rotations,
            translation=translation,
            joint_translations=moving,
            face=track,
        )


def ground_positions(rig: ModelJoints, motion: Motion) -> np.ndarray:
    """Return x and z of the model's root, (T, 2) in m."""
    return motion.positions()[:, rig.root][:, GROUND]


def _fractions(count: int) -> np.ndarray:
    """Return 1/count ... (count - 1)/count."""
    return np.arange(1, count) / count


def mixed_motions(locked: Motion, motion: Motion, given: np.ndarray) -> Motion:
    """Return `locked` mixed with `motion` by the weights `given` (T,) of the latter."""
    given = given[:, None]

    def mixed(before: np.ndarray, after: np.ndarray) -> np.ndarray:
        between = before + (1 - given) * (after - before)
        return np.where(given == 0, after, np.where(given == 1, before, between))

    turns = slerp(
        motion.rotations, locked.rotations, np.broadcast_to(1 - given, motion.rotations.shape[:2])
    )
    turns = np.where(given[..., None] == 1, motion.rotations, turns)
    return replace(
        locked,
        rotations=np.where(given[..., None] == 0, locked.rotations, turns),
        translation=mixed(motion.translation, locked.translation),
        joint_translations={
            name: mixed(motion.joint_translations[name], places)
            for name, places in locked.joint_translations.items()
        },
    )
