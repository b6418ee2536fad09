"""Colours of the materials of a glTF file, from base colours and textures."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
from PIL import Image, UnidentifiedImageError

from gesturekit.formats.gltf.file import Gltf
from gesturekit.formats.gltf.skin import unique_rows
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


class Colours:
    """Colours of the materials of a file."""

    def __init__(self, glb: Gltf) -> None:
        self._glb = glb
        self._images: dict[int, np.ndarray | None] = {}

    def at(self, material: object, uv: np.ndarray | None, n_points: int) -> np.ndarray:
        """Return RGBA (N, 4) of a material at texture coordinates (N, 2), 0 to 1, sRGB.

        Opaque materials have an alpha of 1.

        Warns:
            UserWarning: a texture that cannot be read; its base colour is used.
        """
        if material is None:
            return np.broadcast_to([0.8, 0.8, 0.8, 1.0], (n_points, 4))
        glb = self._glb
        found = glb.item("materials", material)
        surface = glb.object(found, "pbrMetallicRoughness")
        factor = np.clip(glb.numbers(surface, "baseColorFactor", [1.0] * 4), 0, 1)
        factor[:3] = np.where(
            factor[:3] <= 0.0031308, 12.92 * factor[:3], 1.055 * factor[:3] ** (1 / 2.4) - 0.055
        )
        rgba = np.broadcast_to(factor, (n_points, 4)).copy()
        texture = self._texture(glb.object(surface, "baseColorTexture"))
        if texture is not None and uv is not None:
            height, width = texture.shape[:2]
            column, row = ((uv % 1.0) * [width, height]).astype(int).T
            rgba *= texture[np.minimum(row, height - 1), np.minimum(column, width - 1)] / 255
        if found.get("alphaMode", "OPAQUE") == "OPAQUE":
            rgba[:, 3] = 1.0
        return rgba

    def _texture(self, reference: dict[str, Any]) -> np.ndarray | None:
        """Return the RGBA image (H, W, 4) uint8 of a texture."""
        if "index" not in reference:
            return None
        glb = self._glb
        texture = glb.item("textures", index := reference["index"])
        extensions = glb.object(texture, "extensions")
        source = texture.get("source", glb.object(extensions, "EXT_texture_webp").get("source"))
        image = {} if source is None else glb.item("images", source)
        at = ~index if source is None else source
        if at not in self._images:
            name = image.get("name") or texture.get("name") or index
            self._images[at] = self._image(image, str(name)[:60], ", ".join(extensions))
        return self._images[at]

    def _image(self, image: dict[str, Any], name: str, extensions: str) -> np.ndarray | None:
        """Return the image of a texture; None, with a warning, if it cannot be read."""
        glb = self._glb
        try:
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
        except Exception as error:  # Pillow's decoders raise anything
            reason = str(error)[:120]
            if isinstance(error, UnidentifiedImageError) or not image:
                kind = image.get("mimeType") or extensions or "its image"
                reason = f"{str(kind)[:60]} is none of {', '.join(_FORMATS)}"
            warnings.warn(
                f"{glb.path}: texture {printable(name)} cannot be read ({reason}): the base "
                "colour of its material is used",
                stacklevel=2,
            )
            return None


def is_seen(alpha: np.ndarray) -> np.ndarray:
    """Return whether faces (F,) are drawn, from the alpha (F, 3) of their corners."""
    return alpha.mean(axis=1) >= _CUT


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
