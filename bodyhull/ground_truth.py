"""`bodyhull ground-truth`: a person's true shape from a sequence in minimal clothing (paper section 5.2.1).

Every frame is registered with all its points as skin, which is what a cloth alignment is; the mean of the
unposed templates is the shape. `bodyhull evaluate --truth` takes it by the paper's protocol: posed to the
result.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bodyhull.config import RunConfig
from bodyhull.errors import UserError
from bodyhull.fit_input import scan_stage
from bodyhull.fitting import fit_stage
from bodyhull.folder import RunFolder, load_arrays, save_arrays
from fit.body.model import load_body


@dataclass(frozen=True)
class TrueShape:
    """What was written: frames used, and how far apart their templates lie, mm (RMS)."""

    path: Path
    n_frames: int
    spread_mm: float


def write_ground_truth(source: Path, out: Path, body: str | None = None) -> TrueShape:
    """The shape in `out` (.npz) of a folder of scans, or of a run that holds a fit.

    Scans are fitted in a run folder beside `out`, `<name>-run`, whose finished frames are kept. Raises
    UserError where nothing can be aligned, or where the run's fit is of another body.
    """
    if out.suffix != ".npz":
        raise UserError(f"--out {out}: the shape is written as an .npz file")
    root = source
    if not RunFolder(source).state_file.is_file():
        root = out.with_name(f"{out.stem}-run")
        config = RunConfig(source, root, labels="none", body=body or "free:neutral")
        scan_stage(config)
        fit_stage(config)
    folder = RunFolder(root)
    fit = folder.stage("fit")
    if not fit.get("key"):
        raise UserError(f"{root}: holds no finished fit; run: bodyhull fit {root}")
    if body is not None and body != fit["body"]:
        raise UserError(
            f"{root}: was fitted with body '{fit['body']}', not '{body}'; run: bodyhull fit {root}"
        )
    model = load_body(fit["body"])
    found = [load_arrays(path) for path in sorted((root / "fit" / "alignments").glob("*.npz"))]
    good = [a for a in found if a is not None and str(a["status"]) == "ok"]
    if not good:
        raise UserError(f"{root}: no frame was aligned well, so there is no shape to take the mean of")
    templates = np.stack([a["template"] for a in good])
    betas = np.mean([a["betas"] for a in good], axis=0)
    mean = templates.mean(axis=0)
    save_arrays(
        out,
        template=mean,
        joints=model.joint_regressor @ model.shaped(betas),
        faces=model.faces,
        body_hash=model.content_hash,
        body=fit["body"],
        frame_ids=np.array([int(a["frame_id"]) for a in good]),
    )
    off = np.linalg.norm(templates - mean, axis=2)
    return TrueShape(out, len(good), 1e3 * float(np.sqrt((off**2).mean())))
