"""The innermost loops of skinning and of the Gauss-Newton step, compiled.

`body.skinning` (JAX) is the plain definition and the reference in the tests. A vertex hangs on a few joints
only, so its derivative by the pose is kept as a short list of 3x3 blocks instead of a dense row; what the
step needs is then a pass over these lists and the mesh edges. Symmetric blocks: xx, xy, xz, yy, yz, zz.
Everything that is called from here is in this file: numba looks only at it to see whether what it kept is
stale.
"""

from __future__ import annotations

from typing import no_type_check

import numpy as np

from hull.kernel import kernel, loose_kernel


@kernel
@no_type_check
def pose_vertices(
    template, bone_idx, bone_weight, pairs, pair_joint, correctives, features, world, offsets, corrected,
    turned, posed,
):  # fmt: skip
    """Corrected template, blended rotations (V 3 3) and posed vertices, without the translation.

    pairs (V + 1): which correctives (C 3 9), with the joint that drives each, belong to a vertex.
    """
    for v in range(len(template)):
        for a in range(3):
            corrected[v, a] = template[v, a]
        for c in range(pairs[v], pairs[v + 1]):
            j = pair_joint[c]
            for a in range(3):
                move = 0.0
                for k in range(9):
                    move += correctives[c, a, k] * features[j, k]
                corrected[v, a] += move
        for a in range(3):
            at = 0.0
            for b in range(3):
                r = 0.0
                for k in range(bone_idx.shape[1]):
                    r += bone_weight[v, k] * world[bone_idx[v, k], a, b]
                turned[v, a, b] = r
                at += r * corrected[v, b]
            for k in range(bone_idx.shape[1]):
                at += bone_weight[v, k] * offsets[bone_idx[v, k], a]
            posed[v, a] = at


@kernel
@no_type_check
def pose_blocks(
    corrected, turned, bone_idx, bone_weight, correctives, world, offsets, posed_joints, axes, d_features,
    ptr, joint, behind, pair, blocks,
):  # fmt: skip
    """dv / d(rotation vector of a joint), a 3x3 block for every (vertex, joint) of the lists.

    behind (n): bit k tells that the vertex's bone k hangs behind the joint; pair (n): its corrective, or -1;
    axes (J 3 3): column e is the world axis of entry e; d_features (J 9 3).
    """
    for v in range(len(corrected)):
        for n in range(ptr[v], ptr[v + 1]):
            j = joint[n]
            ax, ay, az = 0.0, 0.0, 0.0
            for k in range(bone_idx.shape[1]):
                if (behind[n] >> k) & 1:
                    b, w = bone_idx[v, k], bone_weight[v, k]
                    x, y, z = corrected[v, 0], corrected[v, 1], corrected[v, 2]
                    ax += w * (
                        world[b, 0, 0] * x + world[b, 0, 1] * y + world[b, 0, 2] * z
                        + offsets[b, 0] - posed_joints[j, 0]
                    )  # fmt: skip
                    ay += w * (
                        world[b, 1, 0] * x + world[b, 1, 1] * y + world[b, 1, 2] * z
                        + offsets[b, 1] - posed_joints[j, 1]
                    )  # fmt: skip
                    az += w * (
                        world[b, 2, 0] * x + world[b, 2, 1] * y + world[b, 2, 2] * z
                        + offsets[b, 2] - posed_joints[j, 2]
                    )  # fmt: skip
            for e in range(3):
                ex, ey, ez = axes[j, 0, e], axes[j, 1, e], axes[j, 2, e]
                blocks[n, 0, e] = ey * az - ez * ay
                blocks[n, 1, e] = ez * ax - ex * az
                blocks[n, 2, e] = ex * ay - ey * ax
            c = pair[n]
            if c >= 0:
                for e in range(3):
                    mx, my, mz = 0.0, 0.0, 0.0
                    for k in range(9):
                        d = d_features[j, k, e]
                        mx += correctives[c, 0, k] * d
                        my += correctives[c, 1, k] * d
                        mz += correctives[c, 2, k] * d
                    for a in range(3):
                        blocks[n, a, e] += turned[v, a, 0] * mx + turned[v, a, 1] * my + turned[v, a, 2] * mz


@kernel
@no_type_check
def moved_by(
    turned, ptr, joint, blocks, bone_idx, bone_weight, by_template, by_pose, by_shift, by_bones, out
):
    """out (V 3): moves of posed vertices by those of template, pose, translation and bone offsets (J 3)."""
    for v in range(len(turned)):
        x, y, z = by_shift[0], by_shift[1], by_shift[2]
        for b in range(3):
            m = by_template[v, b]
            x += turned[v, 0, b] * m
            y += turned[v, 1, b] * m
            z += turned[v, 2, b] * m
        for n in range(ptr[v], ptr[v + 1]):
            for e in range(3):
                m = by_pose[joint[n], e]
                x += blocks[n, 0, e] * m
                y += blocks[n, 1, e] * m
                z += blocks[n, 2, e] * m
        for k in range(bone_idx.shape[1]):
            w, j = bone_weight[v, k], bone_idx[v, k]
            x += w * by_bones[j, 0]
            y += w * by_bones[j, 1]
            z += w * by_bones[j, 2]
        out[v, 0], out[v, 1], out[v, 2] = x, y, z


@kernel
@no_type_check
def gathered(
    turned, ptr, joint, blocks, bone_idx, bone_weight, force, on_template, on_pose, on_shift, on_bones
):
    """The transpose of `moved_by`: on_template is written, the others are added to."""
    for v in range(len(turned)):
        x, y, z = force[v, 0], force[v, 1], force[v, 2]
        on_shift[0] += x
        on_shift[1] += y
        on_shift[2] += z
        for b in range(3):
            on_template[v, b] = turned[v, 0, b] * x + turned[v, 1, b] * y + turned[v, 2, b] * z
        for n in range(ptr[v], ptr[v + 1]):
            for e in range(3):
                on_pose[joint[n], e] += blocks[n, 0, e] * x + blocks[n, 1, e] * y + blocks[n, 2, e] * z
        for k in range(bone_idx.shape[1]):
            w, j = bone_weight[v, k], bone_idx[v, k]
            on_bones[j, 0] += w * x
            on_bones[j, 1] += w * y
            on_bones[j, 2] += w * z


@kernel
@no_type_check
def times_mesh_matrix(edges, own, between, x, out):
    """out = H x for the symmetric blocks of vertices (V 6) and edges (E 6)."""
    for v in range(len(own)):
        a, b, c = x[v, 0], x[v, 1], x[v, 2]
        out[v, 0] = own[v, 0] * a + own[v, 1] * b + own[v, 2] * c
        out[v, 1] = own[v, 1] * a + own[v, 3] * b + own[v, 4] * c
        out[v, 2] = own[v, 2] * a + own[v, 4] * b + own[v, 5] * c
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        xx, xy, xz = between[e, 0], between[e, 1], between[e, 2]
        yy, yz, zz = between[e, 3], between[e, 4], between[e, 5]
        a, b, c = x[j, 0], x[j, 1], x[j, 2]
        p, q, r = x[i, 0], x[i, 1], x[i, 2]
        out[i, 0] += xx * a + xy * b + xz * c
        out[i, 1] += xy * a + yy * b + yz * c
        out[i, 2] += xz * a + yz * b + zz * c
        out[j, 0] += xx * p + xy * q + xz * r
        out[j, 1] += xy * p + yy * q + yz * r
        out[j, 2] += xz * p + yz * q + zz * r


@kernel
@no_type_check
def add_coupling(edges, strength, tether, x, out):
    """out += (L + tether) x, with L of the edges' strengths."""
    for v in range(len(x)):
        for a in range(3):
            out[v, a] += tether * x[v, a]
    for e in range(len(edges)):
        i, j = edges[e, 0], edges[e, 1]
        for a in range(3):
            pull = strength[e] * (x[i, a] - x[j, a])
            out[i, a] += pull
            out[j, a] -= pull


@kernel
@no_type_check
def dense_of_moves(lumped, ptr, joint, blocks, bone_idx, bone_weight, with_bones, out):
    """J^T H J over pose (3 J), translation (3), bone offsets (3 J); H = lumped. Its upper triangle."""
    n_pose = (out.shape[0] - 3) // 2
    left = np.empty((3, 3))
    h = np.empty((3, 3))
    for v in range(len(lumped)):
        h[0, 0], h[0, 1], h[0, 2] = lumped[v, 0], lumped[v, 1], lumped[v, 2]
        h[1, 0], h[1, 1], h[1, 2] = lumped[v, 1], lumped[v, 3], lumped[v, 4]
        h[2, 0], h[2, 1], h[2, 2] = lumped[v, 2], lumped[v, 4], lumped[v, 5]
        if h[0, 0] + h[1, 1] + h[2, 2] <= 0.0:
            continue
        for n in range(ptr[v], ptr[v + 1]):
            at = 3 * joint[n]
            for e in range(3):  # rows of (H B)^T
                for a in range(3):
                    left[e, a] = (
                        blocks[n, 0, e] * h[0, a] + blocks[n, 1, e] * h[1, a] + blocks[n, 2, e] * h[2, a]
                    )
            for m in range(n, ptr[v + 1]):
                to = 3 * joint[m]
                for e in range(3):
                    for f in range(3):
                        out[at + e, to + f] += (
                            left[e, 0] * blocks[m, 0, f]
                            + left[e, 1] * blocks[m, 1, f]
                            + left[e, 2] * blocks[m, 2, f]
                        )
            for e in range(3):
                for a in range(3):
                    out[at + e, n_pose + a] += left[e, a]
            if with_bones:
                for k in range(bone_idx.shape[1]):
                    w = bone_weight[v, k]
                    if w > 0.0:
                        to = n_pose + 3 + 3 * bone_idx[v, k]
                        for e in range(3):
                            for a in range(3):
                                out[at + e, to + a] += w * left[e, a]
        for e in range(3):
            for a in range(3):
                out[n_pose + e, n_pose + a] += h[e, a]
        if with_bones:
            for k in range(bone_idx.shape[1]):
                w = bone_weight[v, k]
                if w > 0.0:
                    to = n_pose + 3 + 3 * bone_idx[v, k]
                    for e in range(3):
                        for a in range(3):
                            out[n_pose + e, to + a] += w * h[e, a]
                    for m in range(bone_idx.shape[1]):
                        u = w * bone_weight[v, m]
                        if u > 0.0 and bone_idx[v, k] <= bone_idx[v, m]:
                            over = n_pose + 3 + 3 * bone_idx[v, m]
                            for e in range(3):
                                for a in range(3):
                                    out[to + e, over + a] += u * h[e, a]


@kernel
@no_type_check
def shape_moves(turned, shape, bone_idx, bone_weight, by_bones, out):
    """out (V 3 B): how betas move posed vertices, through template (V 3 B) and bone offsets (J 3 B)."""
    n_betas = out.shape[2]
    for v in range(len(turned)):
        for a in range(3):
            r0, r1, r2 = turned[v, a, 0], turned[v, a, 1], turned[v, a, 2]
            for b in range(n_betas):
                out[v, a, b] = r0 * shape[v, 0, b] + r1 * shape[v, 1, b] + r2 * shape[v, 2, b]
            for k in range(bone_idx.shape[1]):
                w, j = bone_weight[v, k], bone_idx[v, k]
                if w > 0.0:
                    for b in range(n_betas):
                        out[v, a, b] += w * by_bones[j, a, b]


@kernel
@no_type_check
def weighted_moves(lumped, moves, out):
    """out (V 3 B) = lumped blocks times moves (V 3 B)."""
    for v in range(len(lumped)):
        for b in range(moves.shape[2]):
            x, y, z = moves[v, 0, b], moves[v, 1, b], moves[v, 2, b]
            out[v, 0, b] = lumped[v, 0] * x + lumped[v, 1] * y + lumped[v, 2] * z
            out[v, 1, b] = lumped[v, 1] * x + lumped[v, 3] * y + lumped[v, 4] * z
            out[v, 2, b] = lumped[v, 2] * x + lumped[v, 4] * y + lumped[v, 5] * z


@kernel
@no_type_check
def gathered_columns(ptr, joint, blocks, columns, on_pose, on_shift):
    """on_pose (3 J, B) and on_shift (3, B) of many forces (V 3 B) at once."""
    n_columns = columns.shape[2]
    for v in range(len(columns)):
        for a in range(3):
            for b in range(n_columns):
                on_shift[a, b] += columns[v, a, b]
        for n in range(ptr[v], ptr[v + 1]):
            for e in range(3):
                row = 3 * joint[n] + e
                x, y, z = blocks[n, 0, e], blocks[n, 1, e], blocks[n, 2, e]
                for b in range(n_columns):
                    on_pose[row, b] += x * columns[v, 0, b] + y * columns[v, 1, b] + z * columns[v, 2, b]


@loose_kernel
@no_type_check
def both_ways(matrix, right, left, product, transposed):
    """product (W) = matrix right and transposed (B) = matrix^T left, reading the matrix (W B) once."""
    n = matrix.shape[1]
    for b in range(n):
        transposed[b] = 0.0
    for row in range(matrix.shape[0]):
        total = np.float32(0.0)
        x = left[row]
        for b in range(n):
            m = matrix[row, b]
            total += m * right[b]
            transposed[b] += m * x
        product[row] = total


@kernel
@no_type_check
def betas_along_normals(used, normals, turned, shape, bone_idx, bone_weight, by_bones, out):
    """out (N B): how far the used vertices go along their normals (V 3) with the betas, as `shape_moves`."""
    n_betas = out.shape[1]
    for i in range(len(used)):
        v = used[i]
        for b in range(n_betas):
            out[i, b] = 0.0
        for c in range(3):
            r = 0.0
            for a in range(3):
                r += normals[v, a] * turned[v, a, c]
            for b in range(n_betas):
                out[i, b] += r * shape[v, c, b]
            for k in range(bone_idx.shape[1]):
                w = bone_weight[v, k] * normals[v, c]
                if w != 0.0:
                    for b in range(n_betas):
                        out[i, b] += w * by_bones[bone_idx[v, k], c, b]


@kernel
@no_type_check
def pose_by_columns(used, normals, ptr, joint, blocks, columns, on_pose, on_shift):
    """on_pose (3 J, B), on_shift (3, B): moves along normals by pose and translation, times columns (N B)."""
    n_columns = columns.shape[1]
    for i in range(len(used)):
        v = used[i]
        x, y, z = normals[v, 0], normals[v, 1], normals[v, 2]
        for a in range(3):
            for b in range(n_columns):
                on_shift[a, b] += normals[v, a] * columns[i, b]
        for n in range(ptr[v], ptr[v + 1]):
            for e in range(3):
                along = x * blocks[n, 0, e] + y * blocks[n, 1, e] + z * blocks[n, 2, e]
                row = 3 * joint[n] + e
                for b in range(n_columns):
                    on_pose[row, b] += along * columns[i, b]
