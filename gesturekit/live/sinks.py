"""Sinks of a stream: a recording, and a sender of the Virtual Motion Capture protocol (VMC).

VMC is OSC bundles over UDP, one a frame. Its coordinates are Unity's: left-handed, Y up, metres,
the body facing +Z. Bones are those of Unity's HumanBodyBones, relative to a T-pose. A face is sent
as VRM 0.x's presets and the names of its channels. Source: the VMC protocol specification,
marionette.
"""

from __future__ import annotations

import struct
import tempfile
import time
import wave
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, Protocol

import numpy as np

from gesturekit.errors import ConfigError, GestureKitError
from gesturekit.formats.fbx import blender_command
from gesturekit.formats.gltf.faces import VMC_NAMES, expressions_of
from gesturekit.formats.gltf.vrm import our_names
from gesturekit.formats.npz import frames_header, frames_rows, read_frames
from gesturekit.formats.registry import writer_of
from gesturekit.motion import Motion
from gesturekit.viewer.human import Fitting

if TYPE_CHECKING:
    from pythonosc.osc_bundle import OscBundle

PORT = 39539
"""Port on which programs that draw an avatar listen."""
_TO_UNITY = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0])
"""Factors on x, y, z and a quaternion xyzw: x is mirrored."""


@dataclass(frozen=True)
class Step:
    """Result of one step of the stream.

    Attributes:
        samples: (N,) float32, the sound that the stream got.
        motion: frames that became final; None if none did.
        time: seconds of the sound to which the first of the frames belongs.
        lag: seconds from that sound's capture until now; None without a clock.
    """

    samples: np.ndarray
    motion: Motion | None
    time: float
    lag: float | None


class Sink(Protocol):
    """Receiver of the steps of a stream, with a thread of its own."""

    def put(self, step: Step) -> None:
        """Take a step."""

    def close(self) -> None:
        """End; called once, after the last step."""


def partial_of(path: Path) -> Path:
    """Return the file that holds the frames of a recording until it is whole, beside a .wav."""
    return path.with_name(f"{path.stem}_{path.suffix[1:]}_partial.frames")


class Recording:
    """Sink that writes a file of all motion at the end.

    Until then frames and sound are in the files of `partial_of`, as they came. They stay if the
    disk is full or the process is killed, and both can be read.

    Args:
        path: file to write.
        sample_rate: of the sound, which is written as a .wav of the same name; None without.

    Raises:
        FormatError: no motion is written to such a file, or it needs Blender, which is not found.
        OSError: the folder cannot be written to.
    """

    def __init__(self, path: Path, sample_rate: int | None = None) -> None:
        writer_of(path, ())
        if path.suffix.lower() == ".fbx":
            blender_command(path)
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
        self._path, self._rate, self._partial = path, sample_rate, partial_of(path)
        self._frames: BinaryIO | None = None
        self._sound: wave.Wave_write | None = None
        self._is_cut = False

    def put(self, step: Step) -> None:
        """Append a step.

        Raises:
            ConfigError: the disk is full; the message names what was kept.
        """
        try:
            if self._rate is not None and len(step.samples):
                if self._sound is None:
                    self._sound = wave.open(str(self._partial.with_suffix(".wav")), "wb")  # noqa: SIM115
                    self._sound.setparams((1, 2, self._rate, 0, "NONE", ""))
                whole = np.clip(np.rint(step.samples * 32768), -32768, 32767).astype("<i2")
                # The header counts them at once, so that the file is whole.
                self._sound.writeframes(whole.tobytes())
            if step.motion is not None:
                if self._frames is None:
                    self._frames = self._partial.open("wb")
                    self._frames.write(frames_header(step.motion))
                self._frames.write(frames_rows(step.motion))
                self._frames.flush()
        except (OSError, struct.error) as error:  # struct's: a .wav of 4 GiB
            raise self._cut(error) from None

    def close(self) -> None:
        """Write the files.

        Raises:
            ConfigError: there was no motion, or the files cannot be written; in that case the
                message names what was kept.
        """
        if self._is_cut:
            return
        for file in self._files():
            file.close()
        sound = self._partial.with_suffix(".wav")
        if self._frames is None:
            sound.unlink(missing_ok=True)
            raise ConfigError(f"{self._path}: nothing to record, as no sound came")
        try:
            read_frames(self._partial).save(self._path)
            if self._sound is not None:
                sound.replace(self._path.with_suffix(".wav"))
        except (OSError, GestureKitError) as error:
            raise self._cut(error) from None
        self._partial.unlink()

    def _files(self) -> list[BinaryIO | wave.Wave_write]:
        return [file for file in (self._frames, self._sound) if file is not None]

    def _cut(self, error: Exception) -> ConfigError:
        """End the recording, and return an error that names what there is of it."""
        self._is_cut = True
        for file in self._files():
            with suppress(OSError, struct.error):  # of what it could not write
                file.close()
        kept = [self._partial, self._partial.with_suffix(".wav")]
        names = " and ".join(str(file) for file in kept if file.exists())
        reason = error.strerror if isinstance(error, OSError) else error
        return ConfigError(
            f"{self._path}: {reason}; {names} hold what came until then: "
            f"gesturekit convert {self._partial} {self._path.name}"
        )


class VmcSender:
    """Sink that sends motion to programs such as VSeeFace, Warudo, VNyan, Unity and Unreal.

    Args:
        host: of the program.
        port: on which it listens.
        fitting: puts motion of the stream on the human body.

    Raises:
        ConfigError: an unknown host.
    """

    def __init__(self, host: str, port: int, fitting: Fitting) -> None:
        self._fitting, rig = fitting, fitting.t_pose_rig
        bones = {ours: f"{bone[0].upper()}{bone[1:]}" for bone, ours in our_names(False).items()}
        self._bones = [(joint, bones[name]) for joint, name in enumerate(rig.names)]
        self._offsets = rig.offsets
        from pythonosc.udp_client import UDPClient

        try:
            self._client = UDPClient(host, port)
        except OSError as error:
            raise ConfigError(f"vmc:{host}:{port}: {error.strerror or error}") from None

    def put(self, step: Step) -> None:
        """Send the frames of a step, one after the other at the frame rate."""
        if step.motion is None:
            return
        posed = self._fitting.in_t_pose(step.motion)
        places = np.tile(self._offsets, (posed.n_frames, 1, 1))
        places[:, 0] = posed.translation
        places = np.concatenate([places, posed.rotations], axis=-1) * _TO_UNITY
        face = {} if posed.face is None else expressions_of(posed.face)
        for k, frame in enumerate(places):
            if k and step.lag is not None:
                time.sleep(1 / posed.fps)
            with suppress(OSError):  # a full buffer or a missing network: the next frame may pass
                blends = {VMC_NAMES.get(name, name): float(row[k]) for name, row in face.items()}
                self._client.send(self._bundle(step.time + k / posed.fps, frame, blends))

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    def _bundle(self, seconds: float, frame: np.ndarray, blends: dict[str, float]) -> OscBundle:
        from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
        from pythonosc.osc_message_builder import build_msg

        bundle = OscBundleBuilder(IMMEDIATELY)
        messages: list[tuple[str, list[Any]]] = [
            ("/VMC/Ext/OK", [1]),
            ("/VMC/Ext/T", [seconds]),
            ("/VMC/Ext/Root/Pos", ["root", 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]),
            *(("/VMC/Ext/Bone/Pos", [name, *frame[joint].tolist()]) for joint, name in self._bones),
            *(("/VMC/Ext/Blend/Val", [name, value]) for name, value in blends.items()),
        ]
        if blends:
            messages.append(("/VMC/Ext/Blend/Apply", []))
        for address, arguments in messages:
            bundle.add_content(build_msg(address, arguments))
        return bundle.build()
