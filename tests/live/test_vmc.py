"""VMC datagrams as programs that draw an avatar read them, by a reader of the test's own."""

import socket
import struct
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from loud import raised
from scipy.spatial.transform import Rotation

from gesturekit.live import Step
from gesturekit.live.sinks import VmcSender
from gesturekit.motion.face import FaceTrack
from gesturekit.viewer.human import Fitting, load_human

SILENCE = np.zeros(0, np.float32)
NEEDED = {  # bones that Unity needs for a humanoid
    *("Hips", "Spine", "Chest", "Neck", "Head"),
    *(
        side + bone
        for side in ("Left", "Right")
        for bone in (
            *("Shoulder", "UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot", "Toes"),
            *("ThumbProximal", "ThumbIntermediate", "ThumbDistal", "LittleDistal"),
        )
    ),
}


def text(data: bytes) -> tuple[str, bytes]:
    end = data.index(b"\0")
    return data[:end].decode(), data[end // 4 * 4 + 4 :]


def messages(data: bytes) -> Iterator[tuple[str, list]]:
    """Yield (address, arguments) of an OSC bundle."""
    assert data[:8] == b"#bundle\0"
    data = data[16:]
    while data:
        size = struct.unpack(">i", data[:4])[0]
        address, rest = text(data[4 : 4 + size])
        tags, rest = text(rest)
        arguments = []
        for tag in tags[1:]:
            if tag == "s":
                value, rest = text(rest)
            else:
                value, rest = struct.unpack(f">{tag}", rest[:4])[0], rest[4:]
            arguments.append(value)
        yield address, arguments
        data = data[4 + size :]


@pytest.fixture
def received(skeleton) -> Iterator[list[list]]:
    """received(angles, time, face): what arrives of a right arm raised by angles in degrees."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as reader:
        reader.bind(("127.0.0.1", 0))
        reader.settimeout(5)
        fitting = Fitting(load_human()[0], raised(skeleton, [0.0], 30.0))
        sender = VmcSender("127.0.0.1", reader.getsockname()[1], fitting)

        def send(angles: list[float], time: float, face: FaceTrack | None = None) -> list[list]:
            frames, motion = [], raised(skeleton, np.deg2rad(angles), 30.0)
            motion = replace(motion, face=face)
            for k in range(0, len(angles), 2):  # few at once, so that the system loses none
                sender.put(Step(SILENCE, motion[k : k + 2], time + k / 30, None))
                frames += [list(messages(reader.recv(1 << 16))) for _ in angles[k : k + 2]]
            return frames

        yield send
        sender.close()


def bones(frame: list) -> dict[str, np.ndarray]:
    sent = [values for at, values in frame if at == "/VMC/Ext/Bone/Pos"]
    found = {values[0]: np.array(values[1:]) for values in sent}
    assert len(found) == len(sent)
    return found


def test_a_t_pose_is_unitys(received):
    (frame,) = received([0.0], 1.5)
    assert ("/VMC/Ext/OK", [1]) in frame and ("/VMC/Ext/T", [1.5]) in frame
    assert ("/VMC/Ext/Root/Pos", ["root", 0, 0, 0, 0, 0, 0, 1]) in frame
    found = bones(frame)
    assert found.keys() >= NEEDED
    for name, pose in found.items():
        # Legs reach for where the feet of the speaker are.
        most = 12 if name.endswith(("Leg", "Foot", "Toes")) else 5
        assert np.rad2deg(Rotation.from_quat(pose[3:]).magnitude()) < most, name
    # Metres, Y up; the left of a body that faces +Z is at -x in Unity.
    assert 0.7 < found["Hips"][1] < 1.1
    assert found["LeftUpperLeg"][0] < -0.05 < 0.05 < found["RightUpperLeg"][0]
    assert found["LeftLowerArm"][0] < -0.2 and found["RightLowerArm"][0] > 0.2


def test_a_right_arm_is_raised_to_unitys_right(received):
    (frame,) = received([60.0], 0.0)
    found = bones(frame)
    turn = Rotation.identity()
    for name in ("Hips", "Spine", "Chest", "UpperChest", "RightShoulder", "RightUpperArm"):
        turn = turn * Rotation.from_quat(found[name][3:])
    np.testing.assert_allclose(turn.apply([1, 0, 0]), [0.5, np.sqrt(0.75), 0], atol=0.02)
    np.testing.assert_allclose(np.abs(found["LeftUpperArm"][6]), 1, atol=2e-3)


def test_a_face_is_sent_as_presets_of_vrm_0_and_channels(received):
    names = ("jawOpen", "eyeBlinkLeft", "eyeBlinkRight", "happy")
    face = FaceTrack(names, [[0.75, 1, 0, 0.5], [0, 0, 1, 0.5], [0.25, 0, 0, 2]])
    frames = received([0.0] * 3, 0.0, face)
    sent = [[values for at, values in frame if at == "/VMC/Ext/Blend/Val"] for frame in frames]
    assert dict(sent[0]) == {
        **{"A": 0.75, "I": 0, "U": 0, "E": 0, "O": 0, "Blink_L": 1, "Blink_R": 0, "Joy": 0.5},
        **{"jawOpen": 0.75, "eyeBlinkLeft": 1, "eyeBlinkRight": 0},
    }
    assert [(dict(each)["A"], dict(each)["Blink_R"], dict(each)["Joy"]) for each in sent] == [
        (0.75, 0, 0.5), (0, 1, 0.5), (0.25, 0, 1),
    ]  # fmt: skip
    assert all(frame[-1] == ("/VMC/Ext/Blend/Apply", []) for frame in frames)
    (without,) = received([0.0], 0.0)
    assert not [at for at, _ in without if "Blend" in at]
