"""Sender of the Virtual Motion Capture protocol (VMC): OSC bundles over UDP, one a frame.

Coordinates are Unity's: left-handed, Y up, metres, the body facing +Z. Bones are those of Unity's
HumanBodyBones, relative to a T-pose. Source: the VMC protocol specification, marionette.
"""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any

import numpy as np
from pythonosc.osc_bundle import OscBundle
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.udp_client import UDPClient

from gesturekit.errors import ConfigError
from gesturekit.formats.gltf.vrm import our_names
from gesturekit.live.runner import Step
from gesturekit.viewer.human.body import Fitting

PORT = 39539
"""Port on which programs that draw an avatar listen."""
_TO_UNITY = np.array([-1.0, 1.0, 1.0, 1.0, -1.0, -1.0, 1.0])
"""Factors on x, y, z and a quaternion xyzw: x is mirrored."""


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
        for k, frame in enumerate(places):
            if k and step.lag is not None:
                time.sleep(1 / posed.fps)
            with suppress(OSError):  # a full buffer or a missing network: the next frame may pass
                self._client.send(self._bundle(step.time + k / posed.fps, frame))

    def close(self) -> None:
        """Close the socket."""
        self._client.close()

    def _bundle(self, seconds: float, frame: np.ndarray) -> OscBundle:
        bundle = OscBundleBuilder(IMMEDIATELY)
        root = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0]
        messages: list[tuple[str, list[Any]]] = [
            ("/VMC/Ext/OK", [1]),
            ("/VMC/Ext/T", [seconds]),
            ("/VMC/Ext/Root/Pos", ["root", *root]),
            *(("/VMC/Ext/Bone/Pos", [name, *frame[joint].tolist()]) for joint, name in self._bones),
        ]
        for address, arguments in messages:
            message = OscMessageBuilder(address)
            for argument in arguments:
                message.add_arg(argument)
            bundle.add_content(message.build())
        return bundle.build()
