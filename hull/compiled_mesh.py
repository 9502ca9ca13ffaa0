"""The loops over a mesh that numpy needs many passes for, compiled: the same operations in the same order as
the plain definitions in `hull.cleaning`, `hull.slack` and `hull.ridges`, so the same results to the last bit.
And the box around a picture's person.

Compiled and kept as in `hull.compiled`.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hull.kernel import kernel


@kernel
@no_type_check
def add_face_normals(vertices, faces, normals):
    """Each face's normal, twice its area long, added to its corners' `normals` (V 3)."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = (
            vertices[b, 0] - vertices[a, 0],
            vertices[b, 1] - vertices[a, 1],
            vertices[b, 2] - vertices[a, 2],
        )
        wx, wy, wz = (
            vertices[c, 0] - vertices[a, 0],
            vertices[c, 1] - vertices[a, 1],
            vertices[c, 2] - vertices[a, 2],
        )
        x, y, z = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for k in range(3):
            normals[faces[f, k], 0] += x
            normals[faces[f, k], 1] += y
            normals[faces[f, k], 2] += z


@kernel
@no_type_check
def add_ring(last, faces, normals):
    """What the corners of each face have together, added to each of them."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x = last[a, 0] + last[b, 0] + last[c, 0]
        y = last[a, 1] + last[b, 1] + last[c, 1]
        z = last[a, 2] + last[b, 2] + last[c, 2]
        for k in range(3):
            normals[faces[f, k], 0] += x
            normals[faces[f, k], 1] += y
            normals[faces[f, k], 2] += z


@kernel
@no_type_check
def make_unit(normals):
    for i in range(len(normals)):
        x, y, z = normals[i, 0], normals[i, 1], normals[i, 2]
        length = max(np.sqrt((x * x + y * y) + z * z), 1e-30)
        normals[i, 0], normals[i, 1], normals[i, 2] = x / length, y / length, z / length


@kernel
@no_type_check
def _root(parent, i):
    while parent[i] != i:
        parent[i] = parent[parent[i]]
        i = parent[i]
    return i


@kernel
@no_type_check
def face_pieces(faces, parent, number, label):
    """`hull.cleaning.face_pieces`: pieces are numbered in the order of their first vertices. `parent` (V,):
    0, 1, ...; `number` (V,): -1 throughout."""
    for f in range(len(faces)):
        a = _root(parent, faces[f, 0])
        for k in range(1, 3):
            b = _root(parent, faces[f, k])
            if a < b:
                parent[b] = a
            elif b < a:
                parent[a] = b
                a = b
    for f in range(len(faces)):
        number[_root(parent, faces[f, 0])] = 0
    n_pieces = 0
    for i in range(len(number)):
        if number[i] == 0:
            number[i] = n_pieces
            n_pieces += 1
    for f in range(len(faces)):
        label[f] = number[_root(parent, faces[f, 0])]


@kernel
@no_type_check
def spread_to_neighbours(values, faces, n_rounds):
    """The rounds of `hull.slack.spread_to_neighbours`. `values` is written into."""
    n = len(values)
    rows, n_rows = np.arange(len(faces)), len(faces)
    sums, weights = np.zeros(n), np.zeros(n, dtype=np.int64)
    for _ in range(n_rounds):
        kept = 0
        for r in range(n_rows):
            f = rows[r]
            a, b, c = values[faces[f, 0]], values[faces[f, 1]], values[faces[f, 2]]
            n_known = 3 - np.isnan(a) - np.isnan(b) - np.isnan(c)
            if n_known == 3:
                continue
            rows[kept] = f
            kept += 1
            total = (0.0 if np.isnan(a) else a) + (0.0 if np.isnan(b) else b) + (0.0 if np.isnan(c) else c)
            for k in range(3):
                sums[faces[f, k]] += total
                weights[faces[f, k]] += n_known
        n_rows = kept
        reached = False
        for r in range(n_rows):
            for k in range(3):
                i = faces[rows[r], k]
                if weights[i] > 0 and np.isnan(values[i]):
                    values[i] = sums[i] / weights[i]
                    reached = True
                sums[i], weights[i] = 0.0, 0
        if not reached:
            return


@kernel
@no_type_check
def edge_middles(vertices, normals, faces, least_length, a_of, b_of, middle, way):
    """For `hull.ridges`: the rising edges (a, b) of a closed surface whose ends look the same way about, in
    the order of their corners; their middles (3 N) and the unit ways (3 N) outward. How many they are; the
    arrays have room for more."""
    n = 0
    for k in range(3):
        for f in range(len(faces)):
            a, b = faces[f, k], faces[f, (k + 1) % 3]
            if a >= b:
                continue
            x, y, z = (
                normals[a, 0] + normals[b, 0],
                normals[a, 1] + normals[b, 1],
                normals[a, 2] + normals[b, 2],
            )
            length = np.sqrt((x * x + y * y) + z * z)
            if not length > least_length:
                continue
            scale = 1.0 / max(length, 1e-30)
            way[0, n], way[1, n], way[2, n] = x * scale, y * scale, z * scale
            for axis in range(3):
                middle[axis, n] = 0.5 * (vertices[a, axis] + vertices[b, axis])
            a_of[n], b_of[n] = a, b
            n += 1
    return n


@kernel
@no_type_check
def number_vertices(padded, n_faces_of, first, within, cases):
    """For `hull.marching`: `first` (M,) vertex of each brick, the numbers `within` (M 3 8 8 8) it of those on
    the edges along each axis, and the `cases` (M 8 8 8) of its cubes; how many vertices and faces there are.

    padded (M 9 9 9): bricks and one layer of their neighbours; n_faces_of (256,): of each case.
    """
    n_bricks, side = len(padded), padded.shape[1] - 1
    corners = np.empty(side + 1, dtype=np.uint8)
    n_vertices = n_faces = 0
    for m in range(n_bricks):
        first[m] = n_vertices
        count = 0
        for axis in range(3):
            dx, dy, dz = axis == 0, axis == 1, axis == 2
            for x in range(side):
                for y in range(side):
                    for z in range(side):
                        if padded[m, x, y, z] != padded[m, x + dx, y + dy, z + dz]:
                            within[m, axis, x, y, z] = count
                            count += 1
        n_vertices += count
        for x in range(side):
            for y in range(side):
                for z in range(side + 1):
                    corners[z] = (
                        padded[m, x, y, z]
                        | (padded[m, x, y + 1, z] << 2)
                        | (padded[m, x + 1, y, z] << 4)
                        | (padded[m, x + 1, y + 1, z] << 6)
                    )
                for z in range(side):
                    case = corners[z] | (corners[z + 1] << 1)
                    cases[m, x, y, z] = case
                    n_faces += n_faces_of[case]
    return n_vertices, n_faces


@kernel
@no_type_check
def brick_surface(
    padded, places, neighbours, n_faces_of, edges_of, first, within, cases, inner, outer, faces
):
    """The vertices `inner`, `outer` (3 V) and `faces` (F 3) of `hull.marching.binary_surface`.

    places (3 M) of the bricks, counted from 1; neighbours (M 8): the bricks that begin at each corner of a
    brick; edges_of (256 most 3): the cases.
    """
    n_bricks, side = len(padded), padded.shape[1] - 1
    v = f = 0
    for m in range(n_bricks):
        low_x, low_y, low_z = side * (places[0, m] - 1), side * (places[1, m] - 1), side * (places[2, m] - 1)
        for axis in range(3):
            dx, dy, dz = np.int64(axis == 0), np.int64(axis == 1), np.int64(axis == 2)
            for x in range(side):
                for y in range(side):
                    for z in range(side):
                        here = padded[m, x, y, z]
                        if here == padded[m, x + dx, y + dy, z + dz]:
                            continue
                        near, far = (inner, outer) if here else (outer, inner)
                        near[0, v], near[1, v], near[2, v] = low_x + x, low_y + y, low_z + z
                        far[0, v], far[1, v], far[2, v] = low_x + x + dx, low_y + y + dy, low_z + z + dz
                        v += 1
        for x in range(side):
            for y in range(side):
                for z in range(side):
                    case = cases[m, x, y, z]
                    for nth in range(n_faces_of[case]):
                        for k in range(3):
                            # An edge's number is its axis times 8 plus its lower corner.
                            edge = edges_of[case, nth, k]
                            i, j, h = x + ((edge >> 2) & 1), y + ((edge >> 1) & 1), z + (edge & 1)
                            owner = neighbours[m, (i // side) * 4 + (j // side) * 2 + h // side]
                            faces[f, k] = (
                                first[owner] + within[owner, edge >> 3, i % side, j % side, h % side]
                            )
                        f += 1


@kernel
@no_type_check
def piece_volumes(vertices, faces, label, middle, n_pieces):
    """`hull.cleaning.piece_volumes`: signed, about the `middle`."""
    volume = np.zeros(n_pieces)
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = vertices[a, 0] - middle[0], vertices[a, 1] - middle[1], vertices[a, 2] - middle[2]
        bx, by, bz = vertices[b, 0] - middle[0], vertices[b, 1] - middle[1], vertices[b, 2] - middle[2]
        cx, cy, cz = vertices[c, 0] - middle[0], vertices[c, 1] - middle[1], vertices[c, 2] - middle[2]
        volume[label[f]] += (
            (ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz)) + az * (bx * cy - by * cx)
        ) / 6.0
    return volume


@kernel
@no_type_check
def picture_box(image):
    """(x, y, width, height) of the pixels that are not 0, as `cv2.boundingRect` has it; all 0 without any."""
    height, width = image.shape
    top, bottom, left, right = height, -1, width, -1
    for y in range(height):
        any_bits = np.uint8(0)
        for x in range(width):
            any_bits |= image[y, x]
        if any_bits == 0:
            continue
        top, bottom = min(top, y), y
        for x in range(left):
            if image[y, x]:
                left = x
                break
        for x in range(width - 1, right, -1):
            if image[y, x]:
                right = x
                break
    if bottom < 0:
        return 0, 0, 0, 0
    return left, top, right + 1 - left, bottom + 1 - top
