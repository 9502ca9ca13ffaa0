"""The one typed configuration: the command line is made from it, and it is written to `run.json`."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from bodyhull.errors import UserError

if TYPE_CHECKING:
    from fit.settings import FitSettings
    from hull.visual_hull import HullOptions

Units = Literal["auto", "m", "cm", "mm"]
Up = Literal["auto", "x", "y", "z", "-x", "-y", "-z"]
#: What --labels may be besides a folder.
LABEL_CHOICES = ("auto", "colour", "none")
#: Fields of `RunConfig` that the fit depends on.
FIT_OPTIONS = (
    "body", "keypoints", "pose_prior", "labels", "preset",
    "lambda_skin", "lambda_outside", "lambda_fit", "lambda_cpl", "lambda_prior", "lambda_shape",
)  # fmt: skip


@dataclass(frozen=True)
class RunConfig:
    """What to run on and how."""

    recording: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RECORDING")]
    """Folder of the recording: setup/ and SilhouettesPictures/ (INRIA layout), or videos/ with calibration
    and plates."""
    out: Annotated[Path, tyro.conf.arg(metavar="RUN")]
    """Folder of the run; made if missing. Finished work in it is kept."""
    sequence: Annotated[str | None, tyro.conf.arg(metavar="NAME")] = None
    """Which sequence, where the recording holds several."""
    body: str = "free:neutral"
    """Body model: free:neutral, free:female, free:male, or the path of an .npz or .pkl of SMPL, SMPL-H or
    SMPL-X."""
    calibration: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Calibration to use instead of the recording's own: a file or folder in any format that `bodyhull
    convert` knows."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP:STEP")] = None
    """Which frame numbers; all by default."""
    voxel_mm: float = 8.0
    """Grid spacing of the carving. The surface is found much finer than this."""
    units: Units = "auto"
    """Unit of the calibration's world."""
    up: Up = "auto"
    """World axis that points up."""
    background: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of background plates, <camera>.png, for recordings of videos."""
    keypoints: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder of keypoints to start the pose from, OpenPose's or COCO's: <camera>/<frame>.json, or COCO's
    <camera>.json. Never needed."""
    overwrite: bool = False
    """Redo what this run folder already holds."""
    pose_prior: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Pose prior to use instead of the built-in one: an .npz with mean (69) and covariance (69 x 69), rad."""
    colours: bool = True
    """Colour the hulls from the pictures, where the recording has any."""
    votes: int = 1
    """How many cameras must see background before a place is given up. 2 or 3 are for many cameras and bad
    masks."""
    soft: bool = False
    """Silhouettes hold probabilities (0 to 255) that are weighed against each other, instead of masks."""
    find_faults: bool = True
    """Look for cameras whose silhouette contradicts the others, and keep them from cutting the hull."""
    refine: bool = False
    """Smooth the hulls inwards as far as all silhouettes allow: nearer to the person, in a few seconds a
    frame.
    """

    labels: Annotated[str, tyro.conf.arg(metavar="auto|colour|none|DIR")] = "auto"
    """Skin and cloth: as labelled in the scans' files or told by colour (auto), all cloth (none), or label
    files in a folder."""
    preset: Literal["buff", "inria"] | None = None
    """The paper's own weights for BUFF or INRIA data, instead of ours."""
    lambda_skin: float | None = None
    """Weight of E_skin: bare points lie on the body. Ours is 1."""
    lambda_outside: float | None = None
    """Weight of E_outside: cloth points do not lie inside the body. Ours is 1."""
    lambda_fit: float | None = None
    """Weight of E_fit in fusion and detail: the body stays near its clothes. Ours: see fit/settings.py."""
    lambda_cpl: float | None = None
    """Weight of E_cpl: the free-form body keeps to the model. Ours: see fit/settings.py."""
    lambda_prior: float | None = None
    """Weight of the pose prior. Ours is 0.001."""
    lambda_shape: float | None = None
    """Weight of the shape prior. Ours is 0.001."""

    def carve_settings(self) -> dict[str, object]:
        """What the hulls depend on, besides the files' contents."""
        values = self.as_dict()
        names = ("sequence", "frames", "voxel_mm", "units", "up", "votes", "soft", "find_faults", "refine")
        return {k: values[k] for k in names}

    def hull_options(self) -> HullOptions:
        """The same for `build_hull`."""
        from hull.visual_hull import HullOptions

        return HullOptions(self.votes, self.soft, self.find_faults, self.refine)

    def fit_settings(self) -> dict[str, object]:
        """What the fit depends on, besides the hulls."""
        values = self.as_dict()
        return {k: values[k] for k in FIT_OPTIONS}

    def adapted(self, settings: FitSettings | None = None) -> FitSettings:
        """Settings of the fit with the preset and the lambdas asked for; settings: in place of the usual
        ones.
        """
        from fit.presets import Lambdas, preset, with_lambdas
        from fit.settings import FitSettings

        settings = FitSettings() if settings is None else settings
        if self.preset is not None:
            settings = preset(self.preset, settings)
        names = ("skin", "outside", "fit", "cpl", "prior", "shape")
        try:
            return with_lambdas(settings, Lambdas(**{k: getattr(self, f"lambda_{k}") for k in names}))
        except ValueError as error:
            raise UserError(str(error)) from error

    def as_dict(self) -> dict[str, object]:
        """JSON-ready values; paths made absolute so that the run folder can be used from anywhere."""
        labels = self.labels if self.labels in LABEL_CHOICES else str(Path(self.labels).absolute())
        return {k: str(v.absolute()) if isinstance(v, Path) else v for k, v in asdict(self).items()} | {
            "labels": labels
        }

    @staticmethod
    def from_dict(values: dict[str, object]) -> RunConfig:
        """Inverse of as_dict."""
        paths = {"recording", "out", "calibration", "background", "keypoints", "pose_prior"}
        fields = set(RunConfig.__dataclass_fields__)
        # What an older version did not ask for was as its default is.
        odd = sorted((set(values) - fields) | ({"recording", "out"} - set(values)))
        if odd:
            raise UserError(
                f"run.json: its configuration was written by another version of bodyhull (it differs in "
                f"{', '.join(odd)}); make the run again in another --out"
            )
        known = {k: Path(str(v)) if k in paths and v is not None else v for k, v in values.items()}
        return RunConfig(**known)  # type: ignore[arg-type]


def digest(value: object) -> str:
    """Short hash of JSON-ready settings."""
    return sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()[:12]
