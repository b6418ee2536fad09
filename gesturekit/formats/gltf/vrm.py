"""Avatars: VRM (0.x and 1.0), or with Mixamo's names; their mesh on a rig of our bone names.

Hair, skirts and other bones without a counterpart move with the nearest bone above that has one;
expressions are left out.

A vertex has the colour of its material, from the base colour and its texture.
"""

from __future__ import annotations

import io
import os
import re
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gesturekit.errors import GestureKitError
from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.scene import Nodes
from gesturekit.motion import Skeleton
from gesturekit.motion.body_model import INFLUENCES, Skin, unique_rows, whole_weights
from gesturekit.motion.parts.body_size import body_height
from gesturekit.wording import printable

_FORMATS = ("PNG", "JPEG", "WEBP")
_MOST_PIXELS, _USUAL_PIXELS = 1 << 26, 1 << 24
"""Most pixels of a texture, and of one in a small file; each byte of a file allows two more."""
_SIDE = 512
"""Textures are reduced to this many pixels: vertices are far apart."""
_PALETTE = 128
"""Colours of an avatar."""
_CUT = 0.5
"""Faces of materials with holes that are less opaque are left out."""


Images = dict[int, np.ndarray | None]
"""RGBA images (H, W, 4) uint8 of a file that were decoded, by index; None for unreadable ones."""


def colours_of(
    glb: Gltf, images: Images, material: object, uv: np.ndarray | None, n_points: int
) -> np.ndarray:
    """Return RGBA (N, 4) of a material at texture coordinates (N, 2), 0 to 1, sRGB.

    Opaque materials have an alpha of 1. Images that are decoded are added to `images`.

    Warns:
        UserWarning: a texture that cannot be read; its base colour is used.
    """
    if material is None:
        return np.broadcast_to([0.8, 0.8, 0.8, 1.0], (n_points, 4))
    entry = glb.item("materials", material)
    surface = glb.object(entry, "pbrMetallicRoughness")
    factor = np.clip(glb.numbers(surface, "baseColorFactor", [1.0] * 4), 0, 1)
    factor[:3] = np.where(
        factor[:3] <= 0.0031308, 12.92 * factor[:3], 1.055 * factor[:3] ** (1 / 2.4) - 0.055
    )
    rgba = np.broadcast_to(factor, (n_points, 4)).copy()
    texture = _texture(glb, images, glb.object(surface, "baseColorTexture"))
    if texture is not None and uv is not None:
        height, width = texture.shape[:2]
        column, row = ((uv % 1.0) * [width, height]).astype(int).T
        rgba *= texture[np.minimum(row, height - 1), np.minimum(column, width - 1)] / 255
    if entry.get("alphaMode", "OPAQUE") == "OPAQUE":
        rgba[:, 3] = 1.0
    return rgba


def _texture(glb: Gltf, images: Images, reference: dict[str, Any]) -> np.ndarray | None:
    """Return the RGBA image (H, W, 4) uint8 of a texture; None, with a warning, if unreadable."""
    if "index" not in reference:
        return None
    texture = glb.item("textures", index := reference["index"])
    extensions = glb.object(texture, "extensions")
    source = texture.get("source", glb.object(extensions, "EXT_texture_webp").get("source"))
    image = {} if source is None else glb.item("images", source)
    at = ~index if source is None else source
    if at in images:
        return images[at]
    images[at] = None
    try:
        images[at] = _decoded(glb, image)
    except Exception as error:  # Pillow's decoders raise anything
        reason = str(error)[:120]
        if isinstance(error, UnidentifiedImageError) or not image:
            kind = image.get("mimeType") or ", ".join(extensions) or "its image"
            reason = f"{str(kind)[:60]} is none of {', '.join(_FORMATS)}"
        name = printable(str(image.get("name") or texture.get("name") or index)[:60])
        text = f"texture {name} cannot be read ({reason}): its base colour is used"
        warnings.warn(f"{glb.path}: {text}", stacklevel=2)
    return images[at]


def _decoded(glb: Gltf, image: dict[str, Any]) -> np.ndarray:
    if "bufferView" in image:
        data = glb.view(image["bufferView"])
    else:
        data = glb.resource(image.get("uri"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", Image.DecompressionBombWarning)
        with Image.open(io.BytesIO(data), formats=_FORMATS) as opened:
            n_pixels = opened.width * opened.height
            if n_pixels > min(_MOST_PIXELS, _USUAL_PIXELS + 2 * glb.size):
                raise ValueError(f"{opened.width} by {opened.height} pixels")
            kept = 4 * min(n_pixels, _SIDE * _SIDE)
            glb.spend("its images", decoded=kept, work=n_pixels // 6)
            opened.thumbnail((_SIDE, _SIDE))
            return np.asarray(opened.convert("RGBA"))


def reduce_colours(colours: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return few colours, (R, 3) uint8, and the indices (V,) of those of vertices (V, 3)."""
    pixels = np.rint(np.clip(colours, 0, 1) * 255).astype(np.uint8)
    first, regions = unique_rows(pixels)
    palette = pixels[first]
    if len(palette) > _PALETTE:
        image = Image.fromarray(pixels[None]).quantize(_PALETTE, dither=Image.Dither.NONE)
        regions = np.asarray(image)[0]
        palette = np.array((image.getpalette() or [])[: 3 * _PALETTE], np.uint8).reshape(-1, 3)
    return palette, regions.astype(np.uint8)


_MAX_FACES = 600_000
_TRIANGLES = 4
_STEPS = 3000
"""Work of a piece of mesh."""
_CORNER, _VERTEX, _SKINNED = 24, 100, 200
"""Bytes that a corner of a triangle, a vertex and a joint of a skin take."""
_HEIGHTS = (0.05, 100.0)
"""Plausible body heights, metres."""

_TRUNK = {"hips": "Hips", "spine": "Spine", "chest": "Spine1", "upperChest": "Spine2",
          "neck": "Neck", "head": "Head"}  # fmt: skip
_LIMBS = {"Shoulder": "Shoulder", "UpperArm": "Arm", "LowerArm": "ForeArm", "Hand": "Hand",
          "UpperLeg": "UpLeg", "LowerLeg": "Leg", "Foot": "Foot", "Toes": "ToeBase"}  # fmt: skip
_FINGERS = {"Thumb": "Thumb", "Index": "Index", "Middle": "Middle", "Ring": "Ring",
            "Little": "Pinky"}  # fmt: skip
_SEGMENTS = ("Proximal", "Intermediate", "Distal")
_PREFIX = re.compile(r"^(?:.*[:|])?(?:mixamorig\d*_?)?")
_THUMB_1 = ("Metacarpal", "Proximal", "Distal")
"""Segments of the thumb in VRM 1.0; 0.x names them as it does those of the other fingers."""
_NEEDED = ("hips", "spine", "head", *(
    f"{side}{bone}"
    for side in ("left", "right")
    for bone in ("UpperArm", "LowerArm", "Hand", "UpperLeg", "LowerLeg", "Foot")
))  # fmt: skip


def our_names(is_new: bool) -> dict[str, str]:
    """Return {VRM bone: our bone} of VRM 1.0, or of 0.x."""
    thumb = _THUMB_1 if is_new else _SEGMENTS
    names = dict(_TRUNK)
    for side in ("left", "right"):
        names |= {f"{side}{bone}": f"{side.title()}{ours}" for bone, ours in _LIMBS.items()}
        for finger, ours in _FINGERS.items():
            segments = thumb if finger == "Thumb" else _SEGMENTS
            for k, segment in enumerate(segments, start=1):
                names[f"{side}{finger}{segment}"] = f"{side.title()}Hand{ours}{k}"
    return names


@dataclass(frozen=True, eq=False)
class Avatar:
    """An avatar of a VRM file.

    Attributes:
        gltf: the file.
        nodes: J nodes of the joints, in the rig's order.
        skeleton: J joints with our names, in a pose in which the avatar looks along +Z.
        height: metres.
        is_backwards: whether the file looks along -Z, as in VRM 0.x.
    """

    gltf: Gltf
    nodes: tuple[int, ...]
    skeleton: Skeleton
    height: float
    is_backwards: bool


def read_avatar(path: str | os.PathLike[str]) -> tuple[Avatar, Skin]:
    """Read an avatar and its whole mesh.

    Warns:
        UserWarning: a texture that cannot be read.

    Raises:
        FormatError: no VRM file, damaged, or without a bone that every VRM avatar has.
    """
    gltf = Gltf(path)
    bones, is_backwards = avatar_bones(gltf)
    nodes = Nodes(gltf)
    world = nodes.matrices()
    if is_backwards:
        world[:, [0, 2]] *= -1
    joints = [node for node in nodes.order if node in bones]
    names = [bones[node] for node in joints]
    at = {node: joint for joint, node in enumerate(joints)}
    owners = np.empty(len(nodes.order), int)
    above = []
    for node in nodes.order:
        parent = nodes.parents[node]
        owner = owners[parent] if parent >= 0 else -1
        if node in bones:
            above.append(int(owner))
            owner = at[node]
        owners[node] = owner
    if names[0] != "Hips" or above.count(-1) != 1:
        raise gltf.error("a bone of its humanoid is not below the hips")
    owners = np.maximum(owners, 0)  # what hangs on no bone moves with the hips
    rest = world[joints, :3, 3]
    mesh = _MeshReader(gltf, world, owners).skin(rest)
    try:
        skeleton = _skeleton(names, above, rest, mesh)
        height = body_height(skeleton)
    except GestureKitError as error:
        raise gltf.error(f"its bones form no body: {error}") from None
    if not _HEIGHTS[0] <= height <= _HEIGHTS[1]:
        raise gltf.error(f"its body is {height:g} metres tall")
    return Avatar(gltf, tuple(joints), skeleton, height, is_backwards), mesh


def avatar_facts(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return what a glTF file holds besides a rig and its motion, for a summary.

    Returns:
        `meshes` (their number), `animations` (names), `vrm` ("1.0", "0.x" or None), `humanoid` (the
        number of bones by which it can be an avatar; 0 if it cannot), and `name`, `authors` and
        `licence` of a VRM file, as texts of at most 200 characters, "" where it does not say.

    Raises:
        FormatError: not glTF 2.0, or broken.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # reading its motion said so
        gltf = Gltf(path)
    extensions = gltf.object(gltf.json, "extensions")
    key, vrm = ("VRMC_vrm", "1.0") if "VRMC_vrm" in extensions else ("VRM", "0.x")
    meta = gltf.object(gltf.object(extensions, key), "meta")
    try:
        n_bones = len(avatar_bones(gltf)[0])
    except GestureKitError:
        n_bones = 0

    def text(*keys: str) -> str:
        value = next((meta[key] for key in keys if meta.get(key)), "")
        several = value if isinstance(value, list) else [value]
        return printable(", ".join(each for each in several if isinstance(each, str))[:200])

    names = [printable(str(each.get("name", "")))[:60] for each in gltf.items("animations")]
    return {
        "meshes": len(gltf.items("meshes")),
        "animations": [name or str(k) for k, name in enumerate(names, start=1)],
        "vrm": vrm if key in extensions else None,
        "humanoid": n_bones,
        "name": text("name", "title"),
        "authors": text("authors", "author"),
        "licence": text("licenseUrl", "licenseName", "otherLicenseUrl"),
    }


def avatar_bones(glb: Gltf) -> tuple[dict[int, str], bool]:
    """Return {node: our bone}, and whether the avatar looks along -Z, as in VRM 0.x.

    Raises:
        FormatError: no avatar, or one without a bone that every avatar has.
    """
    extensions = glb.object(glb.json, "extensions")
    is_new = "VRMC_vrm" in extensions
    if not is_new and "VRM" not in extensions:
        return _bones_by_name(glb), False
    humanoid = glb.object(glb.object(extensions, "VRMC_vrm" if is_new else "VRM"), "humanoid")
    listed: list[tuple[Any, dict[str, Any]]]
    if is_new:
        entries = glb.object(humanoid, "humanBones")
        listed = [(name, glb.object(entries, name)) for name in entries]
    else:
        listed = [(each.get("bone"), each) for each in glb.items("humanBones", humanoid)]
    ours = our_names(is_new)
    n_nodes = len(glb.items("nodes"))
    bones: dict[str, int] = {}
    for name, entry in listed:
        if isinstance(name, str) and name in ours:
            bones[name] = glb.whole(entry.get("node"), n_nodes, f"node of bone {name}")
    if missing := [name for name in _NEEDED if name not in bones]:
        raise glb.error(f"its humanoid has no bone {missing[0]!r}")
    if len(set(bones.values())) < len(bones):
        raise glb.error("two bones of its humanoid are one node")
    return {node: ours[name] for name, node in bones.items()}, not is_new


def _bones_by_name(glb: Gltf) -> dict[int, str]:
    """Return {node: our bone} of Mixamo's and Ready Player Me's rigs, which have our names."""
    ours, bones = our_names(True), dict[str, int]()
    for node, entry in enumerate(glb.items("nodes")):
        name = _PREFIX.sub("", str(entry.get("name", "")), count=1)
        if name in ours.values():
            bones.setdefault(name, node)
    if not bones.keys() >= {ours[bone] for bone in _NEEDED}:
        raise glb.error("not a VRM avatar, nor Mixamo's names of bones; export it as VRM")
    return {node: name for name, node in bones.items()}


class _MeshReader:
    """Meshes of a file at rest in the world, on the joints of the rig.

    Args:
        glb: the file.
        world: (N, 4, 4) transforms of its nodes.
        owners: (N,) joint of the rig with which each node moves.
    """

    def __init__(self, glb: Gltf, world: np.ndarray, owners: np.ndarray) -> None:
        glb.refuse_compressed_meshes()
        self._glb, self._world, self._owners = glb, world, owners
        self._images: Images = {}
        self._skins: dict[object, tuple[np.ndarray, np.ndarray]] = {}

    def skin(self, rest: np.ndarray) -> Skin:
        """Return all meshes, on joints at `rest` (J, 3)."""
        glb, pieces, n_faces, n_vertices = self._glb, [], 0, 0
        for node, entry in enumerate(glb.items("nodes")):
            if "mesh" not in entry:
                continue
            for primitive in glb.items("primitives", glb.item("meshes", entry["mesh"])):
                glb.spend("its pieces of mesh", work=_STEPS)
                if primitive.get("mode", _TRIANGLES) != _TRIANGLES:
                    continue  # points and lines; exporters write no strips
                attributes = glb.object(primitive, "attributes")
                faces, used, colours = self._faces(primitive, attributes)
                n_faces += len(faces)
                if n_faces > _MAX_FACES:
                    raise glb.error(f"over {_MAX_FACES} triangles")
                if len(faces):
                    placed = self._placed(node, entry.get("skin"), attributes, used)
                    pieces.append((faces + n_vertices, colours, *placed))
                    n_vertices += len(used)
        if not pieces:
            raise glb.error("it has no mesh of triangles")
        faces, colours, vertices, joints, weights = map(np.concatenate, zip(*pieces))
        palette, regions = reduce_colours(colours)
        return Skin(vertices, faces.astype(np.uint32), joints, weights, rest, regions, palette)

    def _faces(
        self, primitive: dict[str, Any], attributes: dict[str, Any]
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the visible faces (F, 3) of a piece of mesh.

        Also the vertices that they use, (V,) rows of its attributes, and their colours, (V, 3) RGB,
        0 to 1.
        """
        glb = self._glb
        places = glb.array(attributes.get("POSITION"), "POSITION", 3)
        if places.dtype.kind != "f":
            raise glb.error("POSITION holds no floats")
        if "indices" in primitive:
            corners = glb.array(primitive["indices"], "indices", 1)[:, 0]
        else:
            corners = np.arange(len(places))
        if corners.dtype.kind not in "iu" or len(corners) > 3 * _MAX_FACES:
            raise glb.error("indices are not whole numbers, or too many")
        size = len(corners)
        glb.spend("its triangles", decoded=_CORNER * size, work=2 * size)
        corners = corners[: size // 3 * 3].astype(np.int64)
        if len(corners) and not 0 <= corners.min() <= corners.max() < len(places):
            raise glb.error(f"indices are beyond the {len(places)} vertices of their mesh")
        used, faces = np.unique(corners, return_inverse=True)
        faces = faces.reshape(-1, 3)
        glb.spend("its vertices", decoded=_VERTEX * len(used), work=len(used))
        uv = self._rows(attributes, "TEXCOORD_0", used, 2)
        rgba = colours_of(glb, self._images, primitive.get("material"), uv, len(used))
        faces = faces[rgba[:, 3][faces].mean(axis=1) >= _CUT]
        kept, faces = np.unique(faces, return_inverse=True)
        return faces.reshape(-1, 3), used[kept], rgba[kept, :3]

    def _rows(
        self, attributes: dict[str, Any], name: str, rows: np.ndarray, width: int
    ) -> np.ndarray | None:
        """Return rows of an attribute, or None if the mesh lacks it."""
        if name not in attributes:
            return None
        values = self._glb.array(attributes[name], name, width)
        if len(rows) and rows.max() >= len(values):
            raise self._glb.error(f"{name} has {len(values)} elements, fewer than vertices")
        return values[rows]

    def _placed(
        self, node: int, skin: object, attributes: dict[str, Any], used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return vertices (V, 3) in the world, joints and weights (V, 4) as in `Skin`."""
        glb = self._glb
        places = glb.array(attributes["POSITION"], "POSITION", 3)[used].astype(float)
        joints = self._rows(attributes, "JOINTS_0", used, INFLUENCES)
        weights = self._rows(attributes, "WEIGHTS_0", used, INFLUENCES)
        if skin is None or joints is None or weights is None:
            world = self._world[node]
            moved = places @ world[:3, :3].T + world[:3, 3]
            alone = np.zeros((len(moved), INFLUENCES))
            alone[:, 0] = 1.0
            return moved, *whole_weights(np.full(alone.shape, self._owners[node]), alone)
        nodes, moves = self._skin_joints(skin)
        if joints.dtype.kind not in "iu" or joints.min() < 0 or joints.max() >= len(nodes):
            raise glb.error(f"JOINTS_0 is beyond the {len(nodes)} joints of its skin")
        if weights.dtype.kind != "f" or weights.min() < 0:
            raise glb.error("WEIGHTS_0 holds negative or whole numbers")
        total = weights.sum(axis=1, keepdims=True)
        weights = np.where(total > 1e-6, weights / np.maximum(total, 1e-6), [[1.0, 0, 0, 0]])
        moved = np.zeros(places.shape)
        for k in range(INFLUENCES):
            each = moves[joints[:, k]]
            place = np.einsum("vij,vj->vi", each[:, :3, :3], places) + each[:, :3, 3]
            moved += weights[:, k, None] * place
        if not (np.abs(moved) < 1e4).all():
            raise glb.error("its mesh at rest is not finite, or kilometres wide")
        return moved, *whole_weights(self._owners[nodes[joints]], weights)

    def _skin_joints(self, index: object) -> tuple[np.ndarray, np.ndarray]:
        """Return the nodes (J,) of a skin's joints, and the transforms (J, 4, 4) of vertices."""
        glb = self._glb
        entry = glb.item("skins", index)
        if index not in self._skins:
            nodes = np.array(glb.wholes(entry, "joints", len(self._world)), int)
            glb.spend("its skins", decoded=_SKINNED * len(nodes), work=len(nodes))
            moves = self._world[nodes]
            if "inverseBindMatrices" in entry:
                inverse = glb.array(entry["inverseBindMatrices"], "inverseBindMatrices", 16)
                if len(inverse) < len(nodes):
                    raise glb.error(f"{len(inverse)} inverseBindMatrices for {len(nodes)} joints")
                inverse = inverse[: len(nodes)].astype(float).reshape(-1, 4, 4)
                moves = moves @ inverse.swapaxes(1, 2)
            self._skins[index] = nodes, moves
        return self._skins[index]


def _skeleton(names: list[str], parents: list[int], joints: np.ndarray, mesh: Skin) -> Skeleton:
    """Return the rig, with end sites at soles, finger tips and the crown.

    Raises:
        MotionError: offsets that no skeleton has.
    """
    offsets = joints - joints[np.maximum(parents, 0)]
    offsets[0] = joints[0]
    ends: dict[str, tuple[np.ndarray, ...]] = {}
    owners = mesh.joints[:, 0]
    for joint, name in enumerate(names):
        if joint in parents:
            continue
        end = 0.8 * offsets[joint]
        skin = mesh.vertices[owners == joint]
        if name.endswith(("Foot", "ToeBase")) and len(skin):
            end = np.array([0.0, skin[:, 1].min(), skin[:, 2].max()]) - joints[joint] * [0, 1, 1]
        elif name == "Head" and len(skin):
            end = np.array([0.0, skin[:, 1].max() - joints[joint, 1], 0.0])
        ends[name] = (end,)
    return Skeleton(tuple(names), tuple(parents), offsets, end_sites=ends)
