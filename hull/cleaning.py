"""What to keep of a raw surface: checked, free of specks and of pieces that no silhouette needs.

A visual hull is the largest shape that fits the silhouettes, so where limbs cross in the pictures it holds
phantom pieces with nothing in them. A separate piece is kept if it is the largest, or if some picture would
lose something without it (a hand that the grid cut off, a thrown ball); see "safe hulls", Miller and Hilton.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from hull.loops import mesh_loops
from hull.rays import RayScene
from hull.tables import INSIDE, SilhouetteTable

# Below this share of the largest piece's volume a piece is a speck, whatever it covers (5 cm^3 of a person).
SPECK_SHARE = 1e-4
# A piece is needed if in some camera this share of its points is covered by it alone.
_NEEDED_SHARE = 0.1


def keep_what_matters(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], tables: Sequence[SilhouetteTable]
) -> tuple[Bool[np.ndarray, " v"], Int[np.ndarray, "f2 3"], tuple[str, ...]]:
    """Which vertices (V,) stay, faces that count those only, and one sentence for each kind of thing that
    was left out."""
    label = face_pieces(faces, len(vertices))
    if not label.any():
        return np.ones(len(vertices), dtype=bool), faces, ()
    volumes = piece_volumes(vertices, faces, label)
    largest = int(np.argmax(volumes))
    keep = np.zeros(len(volumes), dtype=bool)
    keep[largest] = True
    # Negative volumes are hollows: complements of cones leave none in a hull, only the grid can.
    candidates = np.flatnonzero((volumes > SPECK_SHARE * volumes[largest]) & ~keep)
    phantoms = []
    if len(candidates):
        scene = RayScene(vertices, faces[label == largest], n_threads=1)
        for piece in candidates:
            corners = vertices[np.unique(faces[label == piece])]
            if _is_needed(corners, scene, tables):
                keep[piece] = True
            else:
                phantoms.append(volumes[piece])
    used, faces = compacted(faces[keep[label]], len(vertices))
    notes = []
    if phantoms:
        pieces = "1 separate piece" if len(phantoms) == 1 else f"{len(phantoms)} separate pieces"
        notes.append(f"left out {pieces} ({sum(phantoms) * 1000:.2f} L) that no silhouette needs")
    if keep.sum() > 1:
        parts = ", ".join(f"{volume * 1000:.2f} L" for volume in sorted(volumes[keep], reverse=True))
        notes.append(f"the hull is in {keep.sum()} separate pieces ({parts})")
    return used, faces, tuple(notes)


def face_pieces(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> Int[np.ndarray, " f"]:
    """(F,) number, from 0, of the connected piece each face belongs to."""
    loops = mesh_loops()
    if loops is None:
        return face_pieces_plainly(faces, n_vertices)
    label = np.empty(len(faces), dtype=np.int64)
    loops.face_pieces(faces, np.arange(n_vertices), np.full(n_vertices, -1), label)
    return label


def face_pieces_plainly(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> Int[np.ndarray, " f"]:
    """`face_pieces`, not compiled."""
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_array(
        (np.ones(len(ends), dtype=bool), (ends[:, 0], ends[:, 1])), shape=(n_vertices, n_vertices)
    )
    n_pieces, of_vertex = connected_components(graph.tocsr(), directed=False)
    if n_pieces == 1:
        return np.zeros(len(faces), dtype=np.int64)
    label = of_vertex[faces[:, 0]]
    used = np.bincount(label, minlength=n_pieces) > 0  # vertices without faces are pieces of their own
    return (np.cumsum(used) - 1)[label]


def piece_volumes(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], label: Int[np.ndarray, " f"]
) -> Float[np.ndarray, " p"]:
    """Signed volume, cubic metres, of each closed piece; positive where the faces look outward."""
    middle, loops = vertices.mean(axis=0), mesh_loops()
    if loops is not None:
        return loops.piece_volumes(vertices, faces, label, middle, int(label.max(initial=-1)) + 1)
    a, b, c = ((vertices - middle)[faces[:, k]] for k in range(3))
    return np.bincount(label, np.einsum("fi,fi->f", a, _crossed(b, c)) / 6.0)


def compacted(
    faces: Int[np.ndarray, "f 3"], n_vertices: int
) -> tuple[Bool[np.ndarray, " v"], Int[np.ndarray, "f 3"]]:
    """Which vertices (V,) the faces use, and the same faces in numbers that count only those."""
    used = np.zeros(n_vertices, dtype=bool)
    used[faces.ravel()] = True
    return used, (np.cumsum(used) - 1)[faces]


def vertex_normals(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], n_rings: int = 2
) -> Float[np.ndarray, "v 3"]:
    """(V 3) unit outward normals: the mean of the faces within `n_rings` edges, weighted by their area.

    By area and over two rings, because marching cubes makes slivers, whose own normals are noise, and because
    the stairs of a binary outline are as wide as the faces of a fine grid: on a ball it is half the error of
    weighting by angle, and no vertex is far off.
    """
    loops = mesh_loops()
    if loops is None:
        return vertex_normals_plainly(vertices, faces, n_rings)
    normals = np.zeros((len(vertices), 3))
    loops.add_face_normals(vertices, faces, normals)
    for _ in range(n_rings - 1):
        last, normals = normals, np.zeros((len(vertices), 3))
        loops.add_ring(last, faces, normals)
    loops.make_unit(normals)
    return normals


def vertex_normals_plainly(
    vertices: Float[np.ndarray, "v 3"], faces: Int[np.ndarray, "f 3"], n_rings: int
) -> Float[np.ndarray, "v 3"]:
    """`vertex_normals`, not compiled."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    # Twice the face's area long.
    of_face = _crossed(b - a, c - a)
    starts = np.arange(0, faces.size + 1, 3)
    corners = csr_array((np.ones(faces.size), faces.ravel(), starts), shape=(len(faces), len(vertices)))
    normals = corners.T @ of_face
    for _ in range(n_rings - 1):
        normals = corners.T @ (corners @ normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _crossed(a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "n 3"]:
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    return np.column_stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def is_closed(faces: Int[np.ndarray, "f 3"], n_vertices: int) -> bool:
    """True if every edge is used exactly once in each direction: watertight and consistently oriented."""
    # A matrix of edges, counted: scipy sorts by counting, in a fifth of the time that sorting names takes.
    forth = (faces.ravel().astype(np.int32), faces[:, [1, 2, 0]].ravel().astype(np.int32))
    count = coo_array((np.ones(faces.size, dtype=np.int32), forth), shape=(n_vertices, n_vertices)).tocsc()
    back = count.tocsr()
    return bool(
        len(faces)
        and (count.data == 1).all()
        and np.array_equal(count.indptr, back.indptr)
        and np.array_equal(count.indices, back.indices)
    )


def _is_needed(corners: Float[np.ndarray, "n 3"], scene: RayScene, tables: Sequence[SilhouetteTable]) -> bool:
    for table in tables:
        seen = table.ask_points(corners.T) == INSIDE
        if seen.any() and (~scene.covers(table.centre, corners[seen])).mean() > _NEEDED_SHARE:
            return True
    return False
