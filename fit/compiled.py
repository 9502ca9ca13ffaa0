"""The innermost loops of the data term, compiled: closest points on a moving mesh, and the normal equations.

`closest.closest_points` (open3d) and `normal_equations.accumulate` (numpy) are the plain definitions and the
reference in the tests. The tree over the triangles belongs to the topology: when the mesh moves, only its
boxes are fitted anew, and a search that starts from the triangle of the last step hardly opens any of them.
Everything that is called from here is in this file: numba looks only at it to see whether what it kept is
stale.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hull.kernel import kernel

_CONTACT_M = 1e-4  # as closest.CONTACT_M
_DEEPEST = 64


@kernel
@no_type_check
def pack_triangles(vertices, faces, order, corners):
    """Corners (F 9) of the triangles in the tree's order."""
    for k in range(len(order)):
        for c in range(3):
            v = faces[order[k], c]
            for a in range(3):
                corners[k, 3 * c + a] = vertices[v, a]


@kernel
@no_type_check
def fit_boxes(corners, first, boxes):
    """Boxes (2 L - 1, 6) of a complete binary tree whose leaf l holds triangles first[l] to first[l + 1]."""
    n_leaves = len(first) - 1
    for leaf in range(n_leaves):
        node = n_leaves - 1 + leaf
        for a in range(3):
            low, high = np.inf, -np.inf
            for k in range(first[leaf], first[leaf + 1]):
                for c in range(3):
                    x = corners[k, 3 * c + a]
                    low, high = min(low, x), max(high, x)
            boxes[node, a], boxes[node, 3 + a] = low, high
    for node in range(n_leaves - 2, -1, -1):
        left, right = 2 * node + 1, 2 * node + 2
        for a in range(3):
            boxes[node, a] = min(boxes[left, a], boxes[right, a])
            boxes[node, 3 + a] = max(boxes[left, 3 + a], boxes[right, 3 + a])


@kernel
@no_type_check
def _box_distance(boxes, node, x, y, z):
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@kernel
@no_type_check
def _on_triangle(corners, k, px, py, pz):
    """Squared distance and the second and third barycentric weight of the closest point of triangle k.

    By the regions of the triangle's plane (vertices, edges, inside), as the dot products tell them apart.
    """
    ax, ay, az = corners[k, 0], corners[k, 1], corners[k, 2]
    ux, uy, uz = corners[k, 3] - ax, corners[k, 4] - ay, corners[k, 5] - az
    wx, wy, wz = corners[k, 6] - ax, corners[k, 7] - ay, corners[k, 8] - az
    qx, qy, qz = px - ax, py - ay, pz - az
    uu = ux * ux + uy * uy + uz * uz
    uw = ux * wx + uy * wy + uz * wz
    ww = wx * wx + wy * wy + wz * wz
    uq = ux * qx + uy * qy + uz * qz
    wq = wx * qx + wy * qy + wz * qz
    d3, d4 = uq - uu, wq - uw
    d5, d6 = uq - uw, wq - ww
    vc = uq * d4 - d3 * wq
    vb = d5 * wq - uq * d6
    va = d3 * d6 - d5 * d4
    if uq <= 0.0 and wq <= 0.0:
        s, t = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        s, t = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        s, t = 0.0, 1.0
    elif vc <= 0.0 and uq >= 0.0 and d3 <= 0.0:
        s, t = uq / max(uq - d3, 1e-300), 0.0
    elif vb <= 0.0 and wq >= 0.0 and d6 <= 0.0:
        s, t = 0.0, wq / max(wq - d6, 1e-300)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        t = (d4 - d3) / max((d4 - d3) + (d5 - d6), 1e-300)
        s = 1.0 - t
    else:
        det = max(va + vb + vc, 1e-300)
        s, t = vb / det, vc / det
    ex, ey, ez = qx - s * ux - t * wx, qy - s * uy - t * wy, qz - s * uz - t * wz
    return ex * ex + ey * ey + ez * ez, s, t


@kernel
@no_type_check
def find_closest(points, corners, first, boxes, order, place, guess, triangle, barycentric):
    """Nearest triangle and barycentric weights of every point; guess: a triangle to start from, or -1."""
    n_leaves = len(first) - 1
    waiting = np.empty(_DEEPEST, dtype=np.int64)
    bound = np.empty(_DEEPEST)
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, best_k, best_s, best_t = np.inf, 0, 0.0, 0.0
        if guess[i] >= 0:
            best_k = place[guess[i]]
            best, best_s, best_t = _on_triangle(corners, best_k, x, y, z)
        waiting[0], bound[0], n = 0, 0.0, 1
        while n > 0:
            n -= 1
            if bound[n] >= best:
                continue
            node = waiting[n]
            while node < n_leaves - 1:
                left, right = 2 * node + 1, 2 * node + 2
                to_left = _box_distance(boxes, left, x, y, z)
                to_right = _box_distance(boxes, right, x, y, z)
                near, far, to_near, to_far = left, right, to_left, to_right
                if to_right < to_left:
                    near, far, to_near, to_far = right, left, to_right, to_left
                if to_near >= best:
                    node = -1
                    break
                if to_far < best:
                    waiting[n], bound[n] = far, to_far
                    n += 1
                node = near
            if node < 0:
                continue
            leaf = node - (n_leaves - 1)
            for k in range(first[leaf], first[leaf + 1]):
                squared, s, t = _on_triangle(corners, k, x, y, z)
                if squared < best:
                    best, best_k, best_s, best_t = squared, k, s, t
        triangle[i] = order[best_k]
        barycentric[i, 0] = 1.0 - best_s - best_t
        barycentric[i, 1], barycentric[i, 2] = best_s, best_t


@kernel
@no_type_check
def sum_face_normals(vertices, faces, total):
    """Vertex normals (V 3), not yet of unit length: the sum of the faces', weighted by area."""
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        x, y, z = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        ux, uy, uz = vertices[b, 0] - x, vertices[b, 1] - y, vertices[b, 2] - z
        wx, wy, wz = vertices[c, 0] - x, vertices[c, 1] - y, vertices[c, 2] - z
        nx, ny, nz = uy * wz - uz * wy, uz * wx - ux * wz, ux * wy - uy * wx
        for v in (a, b, c):
            total[v, 0] += nx
            total[v, 1] += ny
            total[v, 2] += nz


@kernel
@no_type_check
def measure(points, vertices, faces, normals, triangle, barycentric, foot, normal, distance, direction):
    """Foot points, normals there, signed distances and their directions, as `Container.closest` has them."""
    for i in range(len(points)):
        f = triangle[i]
        squared, along, length = 0.0, 0.0, 0.0
        for a in range(3):
            at, n = 0.0, 0.0
            for c in range(3):
                at += barycentric[i, c] * vertices[faces[f, c], a]
                n += barycentric[i, c] * normals[faces[f, c], a]
            foot[i, a], normal[i, a] = at, n
            length += n * n
            squared += (points[i, a] - at) ** 2
        length = max(np.sqrt(length), 1e-30)
        for a in range(3):
            normal[i, a] /= length
            along += (points[i, a] - foot[i, a]) * normal[i, a]
        far = np.sqrt(squared)
        if far < _CONTACT_M:
            distance[i] = along
            for a in range(3):
                direction[i, a] = normal[i, a]
        else:
            distance[i] = -far if along < 0 else far
            for a in range(3):
                direction[i, a] = (points[i, a] - foot[i, a]) / distance[i]


@kernel
@no_type_check
def sum_normal_equations(
    faces, face_edges, triangle, barycentric, distance, direction, weight, share, own, between, lumped, rhs
):
    """Add every point's part to the vertices' blocks (V 6), the edges' (E 6), and the right-hand side (V 3).

    Blocks are symmetric: xx, xy, xz, yy, yz, zz. lumped (V 6): what a point does to the edges counted on
    their ends, so that it bounds the whole matrix from above.
    """
    metric = np.empty(6)
    for i in range(len(triangle)):
        w = weight[i]
        if w <= 0.0:
            continue
        f = triangle[i]
        x, y, z = direction[i, 0], direction[i, 1], direction[i, 2]
        plane, round_ = w * (1.0 - share), w * share
        metric[0], metric[1], metric[2] = plane * x * x + round_, plane * x * y, plane * x * z
        metric[3], metric[4], metric[5] = plane * y * y + round_, plane * y * z, plane * z * z + round_
        pull = w * distance[i]
        for c in range(3):
            b = barycentric[i, c]
            v = faces[f, c]
            for k in range(6):
                own[v, k] += b * b * metric[k]
                lumped[v, k] += b * metric[k]
            rhs[v, 0] += b * pull * x
            rhs[v, 1] += b * pull * y
            rhs[v, 2] += b * pull * z
            product = b * barycentric[i, (c + 1) % 3]
            e = face_edges[f, c]
            for k in range(6):
                between[e, k] += product * metric[k]
