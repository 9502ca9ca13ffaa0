"""`bodyhull body`: what a body file holds, the same without a pickle, and a picture of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from bodyhull.errors import OK, UserError
from bodyhull.folder import write_atomically

if TYPE_CHECKING:
    from fit.body import BodyModel
    from fit.body.body_file import BodyFile

FileArgument = Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]


@dataclass(frozen=True)
class BodyInfo:
    """Tell what a body file holds, and measure its mean shape."""

    file: FileArgument
    """An .npz or .pkl of SMPL, SMPL-H or SMPL-X; or free:neutral, free:female, free:male."""


@dataclass(frozen=True)
class BodyConvert:
    """Write a body file as an .npz of plain arrays under SMPL's keys, with its own joints."""

    file: FileArgument
    """An .npz or .pkl of SMPL, SMPL-H or SMPL-X; or free:neutral, free:female, free:male; or anny,
    anny:FOLDER, mhr, mhr:FOLDER (made into SMPL's structure)."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT.npz")]
    """File to write."""
    overwrite: bool = False
    """Replace a file that is there already."""


@dataclass(frozen=True)
class BodyShow:
    """Draw the mean shape from eight sides, or a sheet of shapes and poses, as one PNG."""

    file: FileArgument
    """An .npz or .pkl of SMPL, SMPL-H or SMPL-X; or free:neutral, free:female, free:male."""
    out: Annotated[Path, tyro.conf.arg(metavar="PICTURE.png")]
    """File to write; replaced if it is there."""
    sheet: bool = False
    """The mean, the first five shape components at +-2 standard deviations, and six poses."""


BodyCommand = (
    Annotated[BodyInfo, tyro.conf.subcommand("info")]
    | Annotated[BodyConvert, tyro.conf.subcommand("convert")]
    | Annotated[BodyShow, tyro.conf.subcommand("show")]
)


@dataclass(frozen=True)
class Body:
    """Body files: what one holds (info), the same without a pickle (convert), a picture (show)."""

    action: BodyCommand


def perform_body(command: Body) -> int:
    """Carry out one of the three; returns the exit code."""
    match command.action:
        case BodyInfo(file):
            print(info_text(*opened(file)))
        case BodyConvert():
            convert(command.action)
        case BodyShow():
            show(command.action)
    return OK


def opened(spec: str) -> tuple[BodyFile, BodyModel]:
    """The file's own content, and the body of 24 joints that the fit uses. Raises BodyModelError."""
    from fit.body import BodyModel, load_body
    from fit.body.body_file import read_body_file

    if spec.startswith("free:"):
        model = load_body(spec)
        return model.as_file(), model
    name, _, assets = spec.partition(":")
    if name == "anny":
        from fit.body.anny import anny_body_file

        file = anny_body_file(Path(assets) if assets else None)
    elif name == "mhr":
        from fit.body.mhr import mhr_body_file

        file = mhr_body_file(Path(assets) if assets else None)
    else:
        file = read_body_file(spec)
    return file, BodyModel.of_file(file, spec)


def info_text(file: BodyFile, model: BodyModel) -> str:
    """What the file holds and what a tape reads on its mean shape, for the terminal."""
    n_joints, n_betas = len(file.parents), file.shape_directions.shape[2]
    n_expressions, n_correctives = file.expression_directions.shape[2], file.pose_directions.shape[2]
    folded = " (fitted as 24: hands and face at rest)" if n_joints != model.n_joints else ""
    unused = f" and {n_expressions} of expression, unused" if n_expressions else ""
    zero = "" if file.pose_directions.any() else ", all zero"
    rows = [
        ("name", file.name),
        ("kind", file.kind),
        ("gender", file.gender),
        ("licence", file.licence),
        ("joints", f"{n_joints}{folded}"),
        ("vertices", f"{model.n_vertices}"),
        ("faces", f"{len(model.faces)}"),
        ("betas", f"{n_betas}{unused}"),
        ("correctives", f"{n_correctives}{zero}"),
        ("hash", model.content_hash),
        *measured(model),
        *(("note", note) for note in file.notes),
    ]
    return "\n".join(f"{name:<14}{value}" for name, value in rows)


def measured(model: BodyModel) -> list[tuple[str, str]]:
    """Height, volume, weight and girths of the mean shape; a sentence instead where it cannot be measured."""
    from fit.body.anthropometry import GIRTHS
    from fit.body.girth_lines import measure_body

    try:
        found = measure_body(model, np.zeros(model.n_betas))
    except ValueError as error:
        return [("measures", f"none: {error}")]
    girths = [f"{name} {100 * found[name]:.1f}" for name in GIRTHS]
    return [
        ("height", f"{100 * found['stature']:.1f} cm"),
        ("volume", f"{found['litres']:.1f} litres"),
        ("weight", f"{found['kilograms']:.1f} kg (estimated), body-mass index {found['bmi']:.1f}"),
        ("girths, cm", ", ".join(girths)),
    ]


def convert(command: BodyConvert) -> None:
    """Write the .npz and say so. UserError where it would not be one, or would replace a file."""
    if command.out.suffix.lower() != ".npz":
        raise UserError(f"{command.out}: a body is written as .npz; give a name that ends so")
    if command.out.exists() and not command.overwrite:
        raise UserError(f"{command.out}: is there already; --overwrite replaces it")
    from fit.body.marks import marks_of

    file, model = opened(command.file)
    file.save(command.out, hash=np.array(model.content_hash), **marks_of(model))
    for note in file.notes:
        print(f"note          {note}")
    print(f"{command.out}: {file.kind}, {len(file.parents)} joints, {file.shape_directions.shape[2]} betas")
    print(f"hash          {model.content_hash}")


def show(command: BodyShow) -> None:
    """Write the picture and say so."""
    from render.turntable import png_bytes, sheet, turntable

    if command.out.suffix.lower() != ".png":
        raise UserError(f"{command.out}: a picture is written as .png; give a name that ends so")
    _, model = opened(command.file)
    picture = sheet(model) if command.sheet else turntable(model)
    write_atomically(command.out, lambda path: path.write_bytes(png_bytes(picture)))
    print(f"{command.out}: {picture.shape[1]} x {picture.shape[0]} pixels")
