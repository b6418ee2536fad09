"""Software rasteriser: numba kernels that draw a lit mesh with its shadow over a floor.

All kernels release the GIL, so that several frames are drawn at once.
"""

from __future__ import annotations

import numpy as np

from gesturekit.compiled import compiled

SAMPLES = 2
"""Samples a pixel along each axis."""
_FAST = frozenset({"contract", "reassoc", "nsz", "arcp"})


@compiled(fastmath=_FAST)
def place(vertices, normals, parts, weights, matrices, out, out_normals):
    """Skin vertices and normals (V, 3) with part transforms `matrices` (N, 3, 4)."""
    n_parts = len(matrices)
    turns = np.empty((n_parts, 3, 3), np.float32)
    for n in range(n_parts):  # normals are transformed by the cofactors
        for i in range(3):
            j, k = (i + 1) % 3, (i + 2) % 3
            for a in range(3):
                b, c = (a + 1) % 3, (a + 2) % 3
                turns[n, i, a] = (
                    matrices[n, j, b] * matrices[n, k, c] - matrices[n, j, c] * matrices[n, k, b]
                )
    for v in range(len(vertices)):
        x, y, z = vertices[v]
        nx, ny, nz = normals[v]
        for i in range(3):
            place = np.float32(0.0)
            normal = np.float32(0.0)
            for k in range(parts.shape[1]):
                w = weights[v, k]
                if w == 0:
                    break
                m, t = matrices[parts[v, k]], turns[parts[v, k]]
                place += w * (m[i, 0] * x + m[i, 1] * y + m[i, 2] * z + m[i, 3])
                normal += w * (t[i, 0] * nx + t[i, 1] * ny + t[i, 2] * nz)
            out[v, i], out_normals[v, i] = place, normal


@compiled(fastmath=_FAST)
def light(normals, colours, sun, eye, out):
    """Light vertex colours (V, 3): the sun, a bright sky, and slightly darker edges."""
    for v in range(len(normals)):
        x, y, z = normals[v]
        scale = 1 / max(np.sqrt(x * x + y * y + z * z), np.float32(1e-12))
        x, y, z = x * scale, y * scale, z * scale
        facing = max(x * sun[0] + y * sun[1] + z * sun[2], np.float32(0.0))
        towards = max(x * eye[0] + y * eye[1] + z * eye[2], np.float32(0.0))
        edge = (1 - towards) ** 3
        strength = (0.68 + 0.10 * y + 0.38 * facing) * (1 - 0.22 * edge)
        for c in range(3):
            out[v, c] = min(colours[v, c] * strength, np.float32(255.0))


@compiled(fastmath=_FAST)
def project(vertices, camera, focal, width, height, out):
    """Project vertices (V, 3) to columns, rows and inverse depths (V, 3).

    Args:
        vertices: world positions.
        camera: (4, 3): right, up and backward axes, and the position.
        focal: pixels for a slope of 1.
        width, height: of the image, pixels.
        out: the result; inverse depth is 0 behind the camera.
    """
    right, up, back, eye = camera[0], camera[1], camera[2], camera[3]
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0] - eye[0], vertices[v, 1] - eye[1], vertices[v, 2] - eye[2]
        depth = -(x * back[0] + y * back[1] + z * back[2])
        inverse = 1 / depth if depth > 1e-4 * focal / height else 0.0
        out[v, 0] = 0.5 * width + focal * inverse * (x * right[0] + y * right[1] + z * right[2])
        out[v, 1] = 0.5 * height - focal * inverse * (x * up[0] + y * up[1] + z * up[2])
        out[v, 2] = inverse


@compiled(fastmath=_FAST)
def fill(corners, colours, faces, depths, image):
    """Draw the front faces of a mesh.

    Args:
        corners: (V, 3) of `project`, in samples.
        colours: (V, 3).
        faces: (F, 3).
        depths: (H, W) inverse depths so far, 0 for nothing.
        image: (H, W, 3) colours so far.

    Returns:
        (4,) first row, last row + 1, first column, last column + 1 of what was drawn.
    """
    height, width = depths.shape
    box = np.array([height, 0, width, 0])
    for f in range(len(faces)):
        a, b, c = faces[f]
        xa, ya, za = corners[a]
        xb, yb, zb = corners[b]
        xc, yc, zc = corners[c]
        if za <= 0 or zb <= 0 or zc <= 0:
            continue
        # Rows count downwards, so that a front face has a negative area.
        area = (xb - xa) * (yc - ya) - (yb - ya) * (xc - xa)
        if area >= -1e-9:
            continue
        first = max(int(np.ceil(min(ya, yb, yc) - 0.5)), 0)
        last = min(int(np.floor(max(ya, yb, yc) - 0.5)), height - 1)
        left = max(int(np.ceil(min(xa, xb, xc) - 0.5)), 0)
        right = min(int(np.floor(max(xa, xb, xc) - 0.5)), width - 1)
        if first > last or left > right:
            continue
        box[0], box[1] = min(box[0], first), max(box[1], last + 1)
        box[2], box[3] = min(box[2], left), max(box[3], right + 1)
        scale = 1 / area
        # Barycentric coordinates and their steps from column to column.
        step_b, step_c = (yc - ya) * scale, -(yb - ya) * scale
        ra, ga, ba = colours[a]
        rb, gb, bb = colours[b]
        rc, gc, bc = colours[c]
        for row in range(first, last + 1):
            y = row + 0.5 - ya
            x = left + 0.5 - xa
            wb = (x * (yc - ya) - y * (xc - xa)) * scale
            wc = (y * (xb - xa) - x * (yb - ya)) * scale
            for column in range(left, right + 1):
                if wb >= 0 and wc >= 0 and wb + wc <= 1:
                    z = za + wb * (zb - za) + wc * (zc - za)
                    if z > depths[row, column]:
                        depths[row, column] = z
                        image[row, column, 0] = ra + wb * (rb - ra) + wc * (rc - ra)
                        image[row, column, 1] = ga + wb * (gb - ga) + wc * (gc - ga)
                        image[row, column, 2] = ba + wb * (bb - ba) + wc * (bc - ba)
                wb += step_b
                wc += step_c
    return box


@compiled(fastmath=_FAST)
def cast(vertices, sun, floor, out):
    """Move vertices (V, 3) along the sun's rays to the floor."""
    for v in range(len(vertices)):
        fall = (vertices[v, 1] - floor) / sun[1]
        out[v, 0] = vertices[v, 0] - fall * sun[0]
        out[v, 1] = floor
        out[v, 2] = vertices[v, 2] - fall * sun[2]


@compiled(fastmath=_FAST)
def blur(mask, box, radius, other):
    """Set what is not 0 in the part `box` of `mask` (H, W) to 1, and blur it twice.

    Args:
        mask: the result.
        box: of `fill`; it is widened to all that is not 0 afterwards.
        radius: half the width of the box filter.
        other: (H, W) scratch.
    """
    height, width = mask.shape
    for row in range(box[0], box[1]):
        for column in range(box[2], box[3]):
            mask[row, column] = 1.0 if mask[row, column] > 0 else 0.0
    box[0], box[1] = max(box[0] - 2 * radius, 0), min(box[1] + 2 * radius, height)
    box[2], box[3] = max(box[2] - 2 * radius, 0), min(box[3] + 2 * radius, width)
    top, bottom, left, right = box
    share = np.float32(1 / (2 * radius + 1))
    for _ in range(2):
        for row in range(top, bottom):
            total = np.float32(0.0)
            for column in range(left - radius, right):
                if column + radius < right:
                    total += mask[row, column + radius]
                if column - radius > left:
                    total -= mask[row, column - radius - 1]
                if column >= left:
                    other[row, column] = total * share
        for column in range(left, right):
            total = np.float32(0.0)
            for row in range(top - radius, bottom):
                if row + radius < bottom:
                    total += other[row + radius, column]
                if row - radius > top:
                    total -= other[row - radius - 1, column]
                if row >= top:
                    mask[row, column] = total * share


@compiled(fastmath=_FAST)
def _line(at, thick):
    """Return the strength of the grid lines across an axis; `at` and `thick` are in cells."""
    cell = np.floor(at + np.float32(0.5))
    near = abs(at - cell) / thick
    if near >= 1:
        return np.float32(0.0)
    # Every metre is drawn stronger than the half metres between.
    is_metre = cell == 2 * np.floor(np.float32(0.5) * cell)
    return (1 - near) * np.float32(0.30 if is_metre else 0.16)


@compiled(fastmath=_FAST)
def paint_floor(image, camera, focal, ground, shadow, shade):
    """Paint the background of an image (H, W, 3) uint8: a floor with a grid, and the shadow.

    Args:
        image: the result.
        camera: as in `project`.
        focal: pixels for a slope of 1.
        ground: (5,) height of the floor, x and z of its middle, radius of the grid, and length
            that counts as a metre.
        shadow: mask at half the size of the image, rounded up.
        shade: share of the light that the shadow takes.
    """
    height, width = image.shape[:2]
    right, up, back, eye = camera[0], camera[1], camera[2], camera[3]
    floor, mid_x, mid_z, size, metre = ground
    every = 0.5 * metre
    # Cells are counted from an even one near the middle: float32 holds no large numbers.
    origin_x, origin_z = 2 * np.floor(0.5 * mid_x / every), 2 * np.floor(0.5 * mid_z / every)
    cx, cz = np.float32(mid_x / every - origin_x), np.float32(mid_z / every - origin_z)
    share = np.float32((every / size) ** 2)
    for row in range(height):
        slope = (0.5 * height - row - 0.5) / focal
        down = slope * up[1] - back[1]
        # A gradient from light above to slightly darker below.
        way = np.float32(row / height)
        red, green, blue = 249 - 14 * way, 249 - 12 * way, 248 - 9 * way
        if down >= -1e-6 or eye[1] <= floor:
            image[row, :, 0], image[row, :, 1], image[row, :, 2] = red, green, blue
            continue
        far = (floor - eye[1]) / down
        # Width of a pixel on the floor, along the columns or along the rows, in grid cells.
        below = far - (floor - eye[1]) / (down - up[1] / focal)
        thick = np.float32(max(far / focal, abs(below)) / every)
        ink = np.float32(min(1.0, 0.12 / thick))
        # Places on the floor in grid cells, and squared distances in radii of the floor.
        step_x, step_z = far / focal * right[0], far / focal * right[2]
        left_x = eye[0] + far * (slope * up[0] - back[0]) - (0.5 * width - 0.5) * step_x
        left_z = eye[2] + far * (slope * up[2] - back[2]) - (0.5 * width - 0.5) * step_z
        x, z = np.float32(left_x / every - origin_x), np.float32(left_z / every - origin_z)
        dx, dz = np.float32(step_x / every), np.float32(step_z / every)
        for column in range(width):
            r, g, b = red, green, blue
            at_x, at_z = x + column * dx, z + column * dz
            strength = max(_line(at_x, thick), _line(at_z, thick))
            distance = share * ((at_x - cx) ** 2 + (at_z - cz) ** 2)
            if strength > 0 and distance < 1:
                fade = min(np.float32(1.0), (1 - np.sqrt(distance)) / np.float32(0.75))
                strength *= ink * fade * fade
                r, g, b = (
                    r + strength * (128 - r),
                    g + strength * (140 - g),
                    b + strength * (153 - b),
                )
            dark = shadow[row >> 1, column >> 1]
            if dark > 0 and distance < 1:
                dark = shade * min(dark, np.float32(1.0))
                r, g, b = r + dark * (48 - r), g + dark * (60 - g), b + dark * (76 - b)
            image[row, column, 0] = np.uint8(r)
            image[row, column, 1] = np.uint8(g)
            image[row, column, 2] = np.uint8(b)


@compiled(fastmath=_FAST)
def resolve(depths, samples, box, image):
    """Put the mean of the samples over an image (H, W, 3) uint8, and clear their depths.

    Args:
        depths: (SAMPLES H, SAMPLES W); the background shows where it is 0.
        samples: (SAMPLES H, SAMPLES W, 3) colours.
        box: of `fill`.
        image: the background, and the result.
    """
    top, bottom = box[0] // SAMPLES, -(-box[1] // SAMPLES)
    left, right = box[2] // SAMPLES, -(-box[3] // SAMPLES)
    share = np.float32(1 / (SAMPLES * SAMPLES))
    for row in range(top, bottom):
        for column in range(left, right):
            count = 0
            r = g = b = np.float32(0.0)
            for i in range(SAMPLES):
                for j in range(SAMPLES):
                    y, x = SAMPLES * row + i, SAMPLES * column + j
                    if depths[y, x] > 0:
                        count += 1
                        r += samples[y, x, 0]
                        g += samples[y, x, 1]
                        b += samples[y, x, 2]
                        depths[y, x] = 0
            if count:
                rest = 1 - count * share
                image[row, column, 0] = np.uint8(r * share + rest * image[row, column, 0] + 0.5)
                image[row, column, 1] = np.uint8(g * share + rest * image[row, column, 1] + 0.5)
                image[row, column, 2] = np.uint8(b * share + rest * image[row, column, 2] + 0.5)
