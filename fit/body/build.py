"""The free body from beginning to end, built once and kept in the user's cache.

Half mesh (shipped, the same everywhere) -> people drawn and brought into correspondence -> shape space ->
joint regressor, weights, correctives. Deterministic: the same sources give the same arrays. The three sexes
share one mesh. Licence of the result: CC0.
"""

import hashlib
from collections.abc import Callable
from importlib import resources
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from platformdirs import user_cache_path
from threadpoolctl import threadpool_limits
from tqdm import tqdm

from fit.surface import vertex_areas

from . import half_mesh
from .anatomy import make_person
from .anthropometry import measure
from .correctives import Build, fit_pose_correctives
from .correspondence import Carrier
from .joint_regressor import fit_joint_regressor
from .local_variation import local_components
from .model import BodyModel, BodyModelError
from .parts import body_25_regressor, part_labels, region_mask
from .ramp import smooth_step
from .remesh import SEAM_TOLERANCE_M
from .shape_space import N_ANTHROPOMETRIC, gather_people, principal_components, weight_component
from .skeleton import JOINT, PARENTS
from .skin_weights import make_skin_weights
from .smooth_variation import smooth_components

SEX_COORDINATE: dict[str, float | None] = {"neutral": None, "female": 0.0, "male": 1.0}
N_COMPONENTS = 184
"""Of the shape space: people's principal components, then named local ones, then smooth ones."""
AMPLITUDE = {"torso": 1.1, "leg": 0.95, "arm": 1.0, "neck": 1.0}
"""Standard deviation of smooth variation by region, relative; elsewhere OTHER_AMPLITUDE."""
OTHER_AMPLITUDE = 0.6
WEIGHTS_SD = (-2.0, 2.0)  # the thin and the heavy body whose volume the correctives keep besides the mean's
N_PEOPLE = 360
N_PEOPLE_FOR_JOINTS = 120
DECIMALS = 9  # of the stored arrays: a nanometre, so that a last bit of some BLAS does not change the hash
LICENCE = "CC0-1.0"
GENERATOR = (
    "anatomy.py", "ansur2.json", "anthropometry.py", "bends.py", "build.py", "correctives.py",
    "correspondence.py", "density.py", "dual_quaternions.py", "flesh.py", "foot.py", "girth_solver.py",
    "half_mesh.npz", "half_mesh.py", "hand.py", "head.py", "implicit.py", "implicit_relief.py",
    "implicit_tape.py", "joint_regressor.py", "limbs.py", "local_variation.py", "parts.py", "plan.py",
    "pose_prior.py", "ramp.py", "remesh.py", "sections.py", "segments.py", "shape_space.py", "skeleton.py",
    "skin_weights.py", "smooth_variation.py", "stations.py", "tape.py", "trunk.py", "../surface.py",
)  # fmt: skip


def generator_key() -> str:
    """Sixteen hexadecimal digits that change with any source of the generator."""
    digest = hashlib.sha256()
    for name in GENERATOR:
        digest.update(resources.files(__package__).joinpath(name).read_bytes())
    return digest.hexdigest()[:16]


def cache_folder() -> Path:
    """Where this version of the generator keeps its bodies."""
    return user_cache_path("bodyhull", appauthor=False) / "body" / generator_key()


def load_or_build(sex_name: str, *, show_progress: bool = True, folder: Path | None = None) -> BodyModel:
    """The free body of this sex from the cache; built and kept there when it is not (or no longer readable).

    Two processes may build at once: each writes under a name of its own and renames, and both results are
    equal.
    """
    folder = cache_folder() if folder is None else folder
    path = folder / f"{sex_name}.npz"
    if path.exists():
        try:
            return BodyModel.load(path)
        except BodyModelError:
            pass  # a damaged cache is no reason to stop: it is written anew below
    n_steps = N_PEOPLE + 4
    with (
        threadpool_limits(limits=1, user_api="blas"),  # the order of sums, and so the hash, hangs on threads
        tqdm(total=n_steps, desc=f"building the {sex_name} body", disable=not show_progress) as bar,
    ):
        model = build(*half_mesh.load_half_mesh(), sex_name, bar.update)
    try:
        model.save(path)
    except OSError as error:
        if show_progress:
            tqdm.write(f"The body could not be kept in {folder} ({error}); it will be built again next time.")
    return model


def build(
    half: Float[np.ndarray, "h 3"],
    half_faces: Int[np.ndarray, "g 3"],
    sex_name: str,
    progress: Callable[[], object] = lambda: None,
    *,
    n_people: int = N_PEOPLE,
    seed: int = 0,
) -> BodyModel:
    """The body of this sex on this half mesh; `progress` is called n_people + 4 times."""
    sex = SEX_COORDINATE[sex_name]
    on_seam = half[:, 0] < SEAM_TOLERANCE_M
    whole, faces, partner = half_mesh.mirror(half, half_faces)
    half_area = vertex_areas(whole, faces)[: len(half)] * np.where(on_seam, 1, 2)
    average, _ = make_person(measure(0.5))
    carrier = Carrier(half, half_faces, average)
    people = gather_people(carrier, half_area, n_people, seed, sex, progress)
    mean, components, _ = principal_components(people, half_area, N_ANTHROPOMETRIC)

    def both_sides(array: np.ndarray) -> np.ndarray:
        flip = np.array([-1.0, 1.0, 1.0]).reshape([1, 3] + [1] * (array.ndim - 2))
        return np.concatenate([array, array[~on_seam] * flip])

    template, anthropometric = both_sides(mean), both_sides(components)
    progress()
    regressor = fit_joint_regressor(
        people.halves[:N_PEOPLE_FOR_JOINTS], people.joints[:N_PEOPLE_FOR_JOINTS], partner
    )
    joints = regressor @ template
    progress()
    weights = make_skin_weights(template, faces, partner, joints, measure(0.5 if sex is None else sex))
    parts = part_labels(weights)
    held = _held(template, joints, parts)
    local = local_components(template, faces, joints, weights)
    known = np.concatenate([anthropometric, local], 2)
    n_smooth = N_COMPONENTS - known.shape[2]
    smooth = smooth_components(template, faces, _smooth_amplitude(parts), held, partner, known, n_smooth)
    progress()
    heavier = anthropometric[:, :, weight_component(template, anthropometric, faces)]
    others = tuple(
        Build(template + step * heavier, regressor @ (template + step * heavier)) for step in WEIGHTS_SD
    )
    correctives = fit_pose_correctives(template, faces, weights, joints, partner, others)
    progress()
    return BodyModel(
        name=f"free:{sex_name}",
        licence=LICENCE,
        template=np.round(template, DECIMALS),
        faces=faces.astype(np.int64),
        shape_directions=np.round(np.concatenate([known, smooth], 2), DECIMALS),
        pose_directions=np.round(correctives, DECIMALS),
        weights=weights,
        joint_regressor=regressor,
        parents=np.array(PARENTS),
        parts=parts,
        landmarks=body_25_regressor(template, parts, regressor),
        n_anthropometric=N_ANTHROPOMETRIC,
        gender=sex_name,
    )


def _held(
    template: Float[np.ndarray, "v 3"], joints: Float[np.ndarray, "24 3"], parts: Int[np.ndarray, "v"]
) -> Float[np.ndarray, "v"]:
    """Where the displacement components must vanish: hands, feet, and the head but for its neck side."""
    held = region_mask(parts, "hand", "foot").astype(np.float64)
    head = parts == JOINT["head"]
    above = smooth_step(-0.02, 0.03, template[:, 1] - joints[JOINT["head"], 1])
    jaw = smooth_step(0.02, 0.04, template[:, 2])
    return np.maximum(held, head * np.maximum(above, jaw))


def _smooth_amplitude(parts: Int[np.ndarray, "v"]) -> Float[np.ndarray, "v"]:
    amplitude = np.full(len(parts), OTHER_AMPLITUDE)
    for region, value in AMPLITUDE.items():
        amplitude[region_mask(parts, region)] = value
    return amplitude
