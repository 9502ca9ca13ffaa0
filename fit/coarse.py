"""A low-resolution body for finding the pose: some hundred vertices, linear skinning, analytic derivatives in
numpy.

Pose corrections are left out and normals turn with the blended bones: enough to come within centimetres of a
hull, fast enough to try dozens of starting poses a frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from fit.body.model import BodyModel
from fit.surface import vertex_areas, vertex_normals

#: Metres that a full turn of the normal counts in the nearest-neighbour search.
NORMAL_WEIGHT_M = 0.08
#: The score's cut-off: a point farther than this says nothing about how far.
SCORE_CUT_M = 0.10
#: Deviations of a scan's weights (1 on average) between which it becomes doubtful: hulls of 16 cameras have
#: 0 to 0.04, one of four has 0.45.
DOUBTFUL_SPREAD = (0.1, 0.4)
#: Farther from the body than clothes are, and than the vertices of the coarse body are from each other.
LEFT_OUT_M = 0.12
#: Share of the point-to-point part beside the point-to-plane part, for pairs found from the body and from the
#: scan.
BODY_GLUE, SCAN_GLUE = 0.05, 0.4
#: Radians that a joint may turn in one step.
LARGEST_TURN = 0.6


@dataclass(frozen=True)
class CoarsePose:
    """pose (J 3) rad, translation (3) m, betas (B; only the first few are used), score m (lower is
    better)."""

    pose: Float[np.ndarray, "j 3"]
    translation: Float[np.ndarray, "3"]
    betas: Float[np.ndarray, "b"]
    score: float = np.inf


@dataclass(frozen=True)
class CoarseScan:
    """Points, outward normals, and the search tree over (point, weighted normal); doubt: how much of the
    scan may be space that no camera saw to be empty, 0 (none) to 1."""

    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    tree: cKDTree
    doubt: float = 0.0

    @property
    def stride(self) -> int:
        """Every how-many-th point asks back for its nearest body point: about as many as the body has."""
        return max(1, len(self.points) // 800)

    @staticmethod
    def of(
        points: np.ndarray, normals: np.ndarray, n_points: int = 4000, weight: np.ndarray | None = None
    ) -> CoarseScan:
        """An even subset of an area-uniform scan: dense, so that a body point finds a scan point straight
        ahead of it.

        weight: of the points (`Scan.weight`), uneven where a hull of few cameras is loose.
        """
        keep = np.linspace(0, len(points) - 1, min(n_points, len(points))).astype(int)
        points, normals = points[keep], normals[keep]
        low, high = DOUBTFUL_SPREAD
        doubt = 0.0 if weight is None else float(np.clip((weight.std() - low) / (high - low), 0.0, 1.0))
        return CoarseScan(points, normals, cKDTree(np.hstack([points, NORMAL_WEIGHT_M * normals])), doubt)


@dataclass(frozen=True)
class Targets:
    """3D keypoints to reach: points (L 3) m in the body's frame, weight (L), 0 where nothing was seen."""

    points: Float[np.ndarray, "l 3"]
    weight: Float[np.ndarray, "l"]


@dataclass(frozen=True)
class CoarseBody:
    """Vertices (first n_surface) and landmarks of a body model, with what skinning needs.

    rest, shape: positions and their dependence on the betas; joint_rest, joint_shape: the same of the joints;
    weights (n J); descends (J J): descends[j, k] = 1 where bone k hangs on joint j.
    """

    n_surface: int
    parents: Int[np.ndarray, "j"]
    rest: Float[np.ndarray, "n 3"]
    shape: Float[np.ndarray, "n 3 b"]
    rest_normals: Float[np.ndarray, "n 3"]
    weights: Float[np.ndarray, "n j"]
    joint_rest: Float[np.ndarray, "j 3"]
    joint_shape: Float[np.ndarray, "j 3 b"]
    descends: Float[np.ndarray, "j j"]

    @staticmethod
    def of(model: BodyModel, n_surface: int = 700, n_betas: int = 4) -> CoarseBody:
        """Choose vertices evenly over the area of the model (farthest point sampling, deterministic)."""
        template = model.template
        chosen = farthest_points(template, n_surface, vertex_areas(template, model.faces))
        regressor = np.vstack([np.eye(len(template))[chosen], model.landmarks])
        shape = model.shape_directions[:, :, :n_betas]
        normals = vertex_normals(template, model.faces)[chosen]
        parents = np.asarray(model.parents)
        descends = np.eye(len(parents))
        for j in range(len(parents) - 1, 0, -1):
            descends[parents[j]] += descends[j]
        return CoarseBody(
            n_surface=len(chosen),
            parents=parents,
            rest=regressor @ template,
            shape=np.einsum("nv,vab->nab", regressor, shape),
            rest_normals=np.vstack([normals, np.zeros((len(model.landmarks), 3))]),
            weights=regressor @ model.weights,
            joint_rest=model.joint_regressor @ template,
            joint_shape=np.einsum("jv,vab->jab", model.joint_regressor, shape),
            descends=np.minimum(descends, 1.0),
        )

    @property
    def n_betas(self) -> int:
        """Number of shape coefficients in use."""
        return self.shape.shape[2]

    def forward(self, at: CoarsePose) -> _Posed:
        """Positions, normals and the quantities that the derivatives need."""
        betas = at.betas[: self.n_betas]
        rest = self.rest + self.shape @ betas
        joints = self.joint_rest + self.joint_shape @ betas
        local = Rotation.from_rotvec(at.pose).as_matrix()
        n_joints = len(self.parents)
        world = np.empty((n_joints, 3, 3))
        origin = np.empty((n_joints, 3))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                world[j], origin[j] = local[j], joints[j] + at.translation
            else:
                world[j] = world[parent] @ local[j]
                origin[j] = origin[parent] + world[parent] @ (joints[j] - joints[parent])
        offset = origin - np.einsum("jab,jb->ja", world, joints)
        # Where every bone alone would put every vertex, weighted: (n J 3).
        by_bone = self.weights[:, :, None] * (
            (rest @ world.reshape(-1, 3).T).reshape(len(rest), n_joints, 3) + offset
        )
        blended = (self.weights @ world.reshape(n_joints, 9)).reshape(-1, 3, 3)
        normals = np.einsum("nab,nb->na", blended, self.rest_normals)
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return _Posed(by_bone.sum(1), normals, by_bone, blended, world, origin)

    def jacobian(self, posed: _Posed) -> Float[np.ndarray, "n 3 p"]:
        """dv / d(rotation vectors in the parents' frames (3 J), translation (3), betas)."""
        return self.jacobian_in_world(posed) @ self.world_turns(posed)

    def world_turns(self, posed: _Posed) -> Float[np.ndarray, "p p"]:
        """Columns of `jacobian_in_world` from the parameters: a rotation vector in its parent's frame turned
        into the world's."""
        n_joints = len(self.parents)
        frames = np.stack([np.eye(3) if p < 0 else posed.world[p] for p in self.parents])
        turns = np.zeros((3, n_joints, n_joints, 3))
        each = np.arange(n_joints)
        turns[:, each, each] = frames.transpose(1, 0, 2)
        out = np.eye(3 * n_joints + 3 + self.n_betas)
        out[: 3 * n_joints, : 3 * n_joints] = turns.reshape(3 * n_joints, 3 * n_joints)
        return out

    def jacobian_in_world(
        self, posed: _Posed, out: Float[np.ndarray, "n 3 p"] | None = None
    ) -> Float[np.ndarray, "n 3 p"]:
        """The same with rotations about the world's axes (all joints about x, then y, then z): a cross
        product is then a copy of numbers, and turning the small normal equations costs nothing.

        out: what an earlier call returned, to be filled anew (fresh memory costs as much as the numbers).
        """
        n, n_joints = len(self.rest), len(self.parents)
        moment = np.matmul(self.descends, posed.by_bone)
        share = self.weights @ self.descends.T
        arm = moment - share[:, :, None] * posed.origin
        out = np.zeros((n, 3, 3 * n_joints + 3 + self.n_betas)) if out is None else out
        for axis in range(3):
            after, last = (axis + 1) % 3, (axis + 2) % 3
            turns = slice(axis * n_joints, (axis + 1) * n_joints)
            out[:, last, turns] = arm[:, :, after]
            out[:, after, turns] = -arm[:, :, last]
        out[:, :, 3 * n_joints : 3 * n_joints + 3] = np.eye(3)
        # Betas move the vertex in its bones' frames, and the joints under it.
        shape = np.einsum("nab,nbk->nak", posed.blended, self.shape)
        joint_shift = np.empty((n_joints, 3, self.n_betas))
        for j, parent in enumerate(self.parents):
            if parent < 0:
                joint_shift[j] = self.joint_shape[j]
            else:
                relative = self.joint_shape[j] - self.joint_shape[parent]
                joint_shift[j] = joint_shift[parent] + posed.world[parent] @ relative
        bone_shift = joint_shift - np.einsum("jab,jbk->jak", posed.world, self.joint_shape)
        out[:, :, 3 * n_joints + 3 :] = shape + np.einsum("nj,jak->nak", self.weights, bone_shift)
        return out


@dataclass(frozen=True)
class _Posed:
    points: Float[np.ndarray, "n 3"]
    normals: Float[np.ndarray, "n 3"]
    by_bone: Float[np.ndarray, "n j 3"]
    blended: Float[np.ndarray, "n 3 3"]
    world: Float[np.ndarray, "j 3 3"]
    origin: Float[np.ndarray, "j 3"]


def farthest_points(
    points: Float[np.ndarray, "n 3"], count: int, weight: Float[np.ndarray, "n"]
) -> Int[np.ndarray, "m"]:
    """Greedy farthest-point sampling, the largest-area vertex first."""
    chosen = [int(np.argmax(weight))]
    nearest = ((points - points[chosen[0]]) ** 2).sum(1)
    for _ in range(min(count, len(points)) - 1):
        k = int(np.argmax(nearest))
        chosen.append(k)
        nearest = np.minimum(nearest, ((points - points[k]) ** 2).sum(1))
    return np.array(chosen)


def left_jacobian_inverse(rotation_vector: Float[np.ndarray, "m 3"]) -> Float[np.ndarray, "m 3 3"]:
    """How the rotation vector changes under a small rotation applied from the left."""
    angle = np.linalg.norm(rotation_vector, axis=1)
    half = 0.5 * np.maximum(angle, 1e-6)
    coefficient = (1.0 - half / np.tan(half)) / np.maximum(angle, 1e-6) ** 2
    cross = np.zeros((len(angle), 3, 3))
    x, y, z = rotation_vector.T
    cross[:, 0, 1], cross[:, 0, 2], cross[:, 1, 2] = -z, y, -x
    cross -= cross.transpose(0, 2, 1)
    return np.eye(3) - 0.5 * cross + coefficient[:, None, None] * (cross @ cross)


@dataclass(frozen=True)
class CoarsePrior:
    """Gaussian over all joints but the root: mean (3 (J-1)), precision; weights of pose and betas.

    pose_weight holds at sigma_m and above. Below, the weight falls with the square of sigma, as that of
    residuals of this size would: what is near the scan already must not be pulled off it because few people
    hold their hands on their heads. But not in a doubtful scan: hulls of four cameras have space around the
    person that limbs would wander off into.
    """

    mean: Float[np.ndarray, "m"]
    precision: Float[np.ndarray, "m m"]
    pose_weight: float = 0.004
    sigma_m: float = 0.15
    betas_weight: float = 0.01

    def weight_at(self, sigma_m: float, doubt: float = 0.0) -> float:
        """Weight of the pose beside pairs of this scale; doubt: of the scan, 0 to 1."""
        return self.pose_weight * max(doubt, min(1.0, (sigma_m / self.sigma_m) ** 2))


def score(body: CoarseBody, scan: CoarseScan, at: CoarsePose) -> float:
    """Mean symmetric distance in (point, normal) space, cut off, in metres."""
    posed = body.forward(at)
    own = np.hstack([posed.points[: body.n_surface], NORMAL_WEIGHT_M * posed.normals[: body.n_surface]])
    to_scan = scan.tree.query(own)[0]
    to_body = cKDTree(own).query(scan.tree.data[:: scan.stride])[0]
    return float(0.5 * (np.minimum(to_scan, SCORE_CUT_M).mean() + np.minimum(to_body, SCORE_CUT_M).mean()))


def left_out(body: CoarseBody, scan: CoarseScan, at: CoarsePose) -> float:
    """Share of the scan's points that are farther than LEFT_OUT_M from every vertex of the body."""
    points = body.forward(at).points[: body.n_surface]
    asked = scan.points[:: scan.stride]
    return float((cKDTree(points).query(asked, distance_upper_bound=LEFT_OUT_M)[0] == np.inf).mean())


def refine(
    body: CoarseBody,
    scan: CoarseScan | None,
    prior: CoarsePrior,
    start: CoarsePose,
    sigmas_m: tuple[float, ...],
    iterations: int = 6,
    targets: Targets | None = None,
) -> CoarsePose:
    """Gauss-Newton on symmetric nearest neighbours (and keypoints), sigma from coarse to fine.

    Residuals are mostly along the scan's normals; Geman-McClure weights with the current sigma; pairs whose
    normals oppose are left out. Returns the pose with its score against the scan (infinite without one).
    """
    at = start
    n, n_joints = body.n_surface, len(body.parents)
    size = 3 * n_joints + 3 + body.n_betas
    jacobian: np.ndarray | None = None
    for sigma in sigmas_m:
        pose_weight = prior.weight_at(sigma, 0.0 if scan is None else scan.doubt)
        for _ in range(iterations):
            posed = body.forward(at)
            jacobian = body.jacobian_in_world(posed, jacobian)
            hessian, rhs = np.zeros((size, size)), np.zeros(size)
            if scan is not None:
                own = np.hstack([posed.points[:n], NORMAL_WEIGHT_M * posed.normals[:n]])
                scan_idx = scan.tree.query(own)[1]
                body_idx = cKDTree(own).query(scan.tree.data[:: scan.stride])[1]
                vertex = np.concatenate([np.arange(n), body_idx])
                point = np.concatenate([scan_idx, np.arange(0, len(scan.points), scan.stride)])
                gap = scan.points[point] - posed.points[vertex]
                normal = scan.normals[point]
                agree = (posed.normals[vertex] * normal).sum(1) > 0.0
                weight = agree * (sigma**2 / (sigma**2 + (gap**2).sum(1))) ** 2
                weight = weight / len(weight) * 700.0
                # From the body to the scan mostly along the normal, since sampling noise along the surface
                # acts like glue; from the scan to the body in all directions, since that is what pulls limbs
                # to full length.
                glue = np.repeat((BODY_GLUE, SCAN_GLUE), (n, len(body_idx)))[:, None, None]
                metric = weight[:, None, None] * (
                    (1 - glue) * normal[:, :, None] * normal[:, None, :] + glue * np.eye(3)
                )
                per_vertex = np.zeros((n, 3, 3))
                np.add.at(per_vertex, vertex, metric)
                force = np.zeros((n, 3))
                np.add.at(force, vertex, np.einsum("mab,mb->ma", metric, gap))
                surface = jacobian[:n]
                weighted = np.matmul(per_vertex, surface)
                hessian += surface.reshape(-1, size).T @ weighted.reshape(-1, size)
                rhs += surface.reshape(-1, size).T @ force.ravel()
            if targets is not None:
                gap = np.where(targets.weight[:, None] > 0, targets.points - posed.points[n:], 0.0)
                reach = max(sigma, 0.1)
                weight = 20.0 * targets.weight * (reach**2 / (reach**2 + (gap**2).sum(1))) ** 2
                flat = jacobian[n:].reshape(-1, size)
                hessian += flat.T @ (np.repeat(weight, 3)[:, None] * flat)
                rhs += flat.T @ (np.repeat(weight, 3) * gap.ravel())
            turns_in_world = body.world_turns(posed)
            hessian = turns_in_world.T @ hessian @ turns_in_world
            rhs = turns_in_world.T @ rhs
            inner = slice(3, 3 * n_joints)
            turn = np.zeros((3 * n_joints - 3, 3 * n_joints - 3))
            for j, block in enumerate(left_jacobian_inverse(at.pose[1:])):
                turn[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] = block
            hessian[inner, inner] += pose_weight * turn.T @ prior.precision @ turn
            rhs[inner] -= pose_weight * turn.T @ (prior.precision @ (at.pose[1:].ravel() - prior.mean))
            betas = slice(3 * n_joints + 3, size)
            hessian[betas, betas] += prior.betas_weight * np.eye(body.n_betas)
            rhs[betas] -= prior.betas_weight * at.betas[: body.n_betas]
            hessian[np.diag_indices(size)] += 0.005
            step = cho_solve(cho_factor(hessian), rhs)
            turns = step[: 3 * n_joints].reshape(-1, 3)
            # A joint that hardly any point holds would swing wildly: it is held back alone, not the whole
            # step.
            turns /= np.maximum(1.0, np.linalg.norm(turns, axis=1, keepdims=True) / LARGEST_TURN)
            pose = (Rotation.from_rotvec(turns) * Rotation.from_rotvec(at.pose)).as_rotvec()
            new_betas = at.betas.copy()
            new_betas[: body.n_betas] += step[betas]
            translation = at.translation + step[3 * n_joints : 3 * n_joints + 3]
            moved = max(np.abs(turns).max(), np.abs(step[3 * n_joints :]).max())
            at = CoarsePose(pose, translation, new_betas)
            if moved < 2e-3:
                break
    if scan is None:
        return at
    return CoarsePose(at.pose, at.translation, at.betas, score(body, scan, at))
