"""The command line: a thin skin over one configuration and one function a stage."""

from __future__ import annotations

import dataclasses
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

import bodyhull
from bodyhull.body_commands import Body, perform_body
from bodyhull.calibrate_commands import Calibrate, perform_calibrate
from bodyhull.check_commands import CheckRecording, perform_check
from bodyhull.config import FIT_OPTIONS, RunConfig, Units, Up
from bodyhull.convert_commands import Convert, perform_convert
from bodyhull.errors import ERROR, FRAMES_FAILED, OK, UserError
from bodyhull.folder import RunFolder
from bodyhull.silhouette_commands import MakeSilhouettes, perform_silhouettes
from bodyhull.study_commands import RigStudy, perform_rig_study

if TYPE_CHECKING:
    from fit.settings import FitSettings

RunArgument = Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]


@dataclass(frozen=True)
class Run(RunConfig):
    """The main job: a recording in, a body and overlay films out. Finished work is kept; run it again to
    resume."""


@dataclass(frozen=True)
class Carve(RunConfig):
    """The first stages: silhouettes to one visual hull a frame."""


@dataclass(frozen=True)
class Fit:
    """Fit the body to the hulls of a run, or to a folder of scans: cloth alignments, fusion shape, track."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|SCANS")]
    """Run folder with hulls; or, with --out, a folder of scans, one .ply, .obj, .off or .npz a frame."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None
    """Run folder to make from a folder of scans. Finished work in it is kept."""
    body: str | None = None
    """Body model, if another than the run was made with: free:neutral, free:female, free:male, or a path."""
    keypoints: Path | None = None
    """Folder of keypoints, OpenPose's or COCO's, to start the pose from."""
    overwrite: bool = False
    """Replace the fit that the folder holds."""
    pose_prior: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None
    """Pose prior, if another than the run was made with: an .npz with mean (69) and covariance (69 x 69)."""
    frames: Annotated[str | None, tyro.conf.arg(metavar="START:STOP:STEP")] = None
    """Which scans; all by default."""
    units: Units = "auto"
    """Unit of the scans."""
    up: Up = "auto"
    """Axis of the scans that points up."""
    labels: Annotated[str | None, tyro.conf.arg(metavar="auto|colour|none|DIR")] = None
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


@dataclass(frozen=True)
class Overlay:
    """Draw the overlay films and the report of a fitted run."""

    run: RunArgument
    """Run folder with a fit."""
    overwrite: bool = False
    """Draw films again that are there already."""


@dataclass(frozen=True)
class Evaluate:
    """Compare a fitted run with the true naked body, by the paper's measure and directly."""

    run: RunArgument
    """Run folder with a fit."""
    truth: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Folder that holds <sequence>.npz with the true vertices, or that file."""


@dataclass(frozen=True)
class GroundTruth:
    """The true shape of a person from a sequence in minimal clothing: the mean of its alignments."""

    source: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="SCANS|RUN")]
    """Folder of scans, or a run that was fitted."""
    out: Annotated[Path, tyro.conf.arg(metavar="TRUTH.npz")]
    """File to write; `bodyhull evaluate --truth` takes it."""
    body: str | None = None
    """Body model: free:neutral, free:female, free:male, or a path."""


@dataclass(frozen=True)
class Synth:
    """Film a clothed synthetic person with a synthetic rig: a recording in the INRIA layout, with the
    truth."""

    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="OUT")]
    """Folder of the recording to make."""
    cameras: int = 16
    """How many cameras."""
    size: Annotated[str, tyro.conf.arg(metavar="WxH")] = "1024x1024"
    """Picture size in pixels."""
    layout: Literal["dome", "ring", "cage"] = "dome"
    """Where the cameras stand."""
    frames: int = 24
    """How many frames."""
    motion: str = "tilt-twist"
    """What the person does; an unknown name lists them all."""
    garment: str = "tshirt-trousers"
    """What the person wears; an unknown name lists them all."""
    seed: int = 0
    """Another number, another person."""
    body: str = "free:neutral"
    """Body model that the person is drawn from."""
    overwrite: bool = False
    """Replace a recording that is there already."""


@dataclass(frozen=True)
class Doctor:
    """Look at this machine: Python, versions, off-screen OpenGL, cores, memory, GPU."""


@dataclass(frozen=True)
class Demo:
    """Film a clothed synthetic person, run everything on the recording, compare with the truth."""

    out: Path = Path("demo")
    """Folder for the recording and the run."""
    seed: int = 7
    """Another number, another person."""
    motion: str = "tilt-twist"
    """What the person does."""
    garment: str = "tshirt-trousers"
    """What the person wears."""


Command = (
    Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Synth, tyro.conf.subcommand("synth")]
    | Annotated[GroundTruth, tyro.conf.subcommand("ground-truth")]
    | Annotated[Carve, tyro.conf.subcommand("carve")]
    | Annotated[Fit, tyro.conf.subcommand("fit")]
    | Annotated[Overlay, tyro.conf.subcommand("overlay")]
    | Annotated[Evaluate, tyro.conf.subcommand("evaluate")]
    | Annotated[Body, tyro.conf.subcommand("body")]
    | Annotated[RigStudy, tyro.conf.subcommand("rig-study")]
    | Annotated[Convert, tyro.conf.subcommand("convert")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
    | Annotated[MakeSilhouettes, tyro.conf.subcommand("silhouettes")]
    | Annotated[CheckRecording, tyro.conf.subcommand("check")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Demo, tyro.conf.subcommand("demo")]
)


def joined_signs(arguments: Sequence[str]) -> list[str]:
    """`--up -y` and `--frames -10::` as one word each, so that their values are not taken for options."""
    out: list[str] = []
    for word in arguments:
        if out and out[-1] in ("--up", "--frames") and word.startswith("-") and not word.startswith("--"):
            out[-1] = f"{out[-1]}={word}"
        else:
            out.append(word)
    return out


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of the `bodyhull` command; exits with 0, 1 (error), 2 (usage) or 3 (finished, but frames
    failed)."""
    words = joined_signs(sys.argv[1:] if arguments is None else arguments)
    command: Command = tyro.cli(
        Command,
        prog="bodyhull",
        description=bodyhull.__doc__,
        args=words,
        config=(tyro.conf.OmitSubcommandPrefixes, tyro.conf.FlagCreatePairsOff),
    )
    sys.exit(guarded(command))


def guarded(command: object) -> int:
    """Run a command; a user's mistake becomes one or two lines on standard error and exit code 1."""
    from capture.errors import RecordingError
    from fit.body.model import BodyModelError
    from fit.truth import TruthError
    from hull.errors import HullError
    from hull.mesh_file import MeshFileError
    from render.gl import GlError
    from render.synthetic import SyntheticError

    known = (
        UserError,
        RecordingError,
        HullError,
        MeshFileError,
        BodyModelError,
        TruthError,
        GlError,
        SyntheticError,
    )
    try:
        return perform(command)
    except known as error:
        print(f"bodyhull: error: {error}", file=sys.stderr)
        return ERROR
    except OSError as error:
        # A full disk, a missing permission, a drive that went away: Python's own text names the file and the
        # reason.
        print(f"bodyhull: error: {error}", file=sys.stderr)
        return ERROR
    except KeyboardInterrupt:
        print("bodyhull: stopped; what is finished is kept, run the same command to go on", file=sys.stderr)
        return 130


def perform(command: object) -> int:
    """Dispatch; returns the exit code."""
    match command:
        case Run():
            return run(RunConfig(**dataclasses.asdict(command)))
        case Carve():
            from bodyhull.carving import carve_stage

            config = RunConfig(**dataclasses.asdict(command))
            carve_stage(config)
            return frames_code(config.out, "hull")
        case Fit():
            return fit(command)
        case Overlay():
            from bodyhull.drawing import draw_stage

            draw_stage(configuration_of(command.run, command.overwrite))
            print(f"report: {RunFolder(command.run).report}")
            return OK
        case Evaluate():
            return evaluate(command)
        case GroundTruth():
            from bodyhull.ground_truth import write_ground_truth

            made = write_ground_truth(command.source, command.out, command.body)
            print(
                f"shape: {made.path}   mean of {made.n_frames} frames, {made.spread_mm:.1f} mm RMS around it"
            )
            return OK
        case Synth():
            return synthesise(command)
        case Body():
            return perform_body(command)
        case RigStudy():
            return perform_rig_study(command)
        case Convert():
            return perform_convert(command)
        case Calibrate():
            return perform_calibrate(command)
        case MakeSilhouettes():
            return perform_silhouettes(command)
        case CheckRecording():
            return perform_check(command)
        case Doctor():
            from bodyhull.doctor import findings, print_findings

            return OK if print_findings(findings()) else ERROR
        case Demo():
            return demo(command)
    raise AssertionError(f"no such command: {command!r}")


def configuration_of(root: Path, overwrite: bool = False, **changes: Any) -> RunConfig:
    """The configuration that a run folder was made with, with the changes asked for (None: none)."""
    folder = RunFolder(root)
    state = folder.require_state()
    config = dataclasses.replace(RunConfig.from_dict(state["configuration"]), out=root, overwrite=overwrite)
    return dataclasses.replace(config, **{k: v for k, v in changes.items() if v is not None})


def fit(command: Fit) -> int:
    """Fit a run folder, or a folder of scans into a new one."""
    from bodyhull.fit_input import scan_stage
    from bodyhull.fitting import fit_stage

    options = {k: getattr(command, k) for k in FIT_OPTIONS}
    root = command.run if command.out is None else command.out
    if command.out is not None:
        if command.keypoints is not None:
            raise UserError("--keypoints: scans have no cameras that keypoints could belong to; leave it out")
        given = {k: v for k, v in options.items() if v is not None}
        scan_stage(
            RunConfig(
                command.run,
                root,
                frames=command.frames,
                units=command.units,
                up=command.up,
                overwrite=command.overwrite,
                **given,
            )
        )
    elif (command.frames, command.units, command.up) != (None, "auto", "auto"):
        raise UserError("--frames, --units and --up are for scans: give the run folder to make with --out")
    elif not RunFolder(root).state_file.is_file() and root.is_dir():
        from hull.scan_files import list_scans

        list_scans(root)
        raise UserError(f"{root}: holds scans; say where their run goes: bodyhull fit {root} --out RUN")
    config = configuration_of(root, command.overwrite, **options)
    fit_stage(config)
    folder = RunFolder(root)
    print(f"fusion shape: {folder.fusion_mesh}\nbodies:       {folder.mesh(0).parent}")
    return frames_code(root, "fit")


def frames_code(root: Path, stage: str) -> int:
    """Exit code after a stage, 3 where frames failed; they and suspect hulls are named in a sentence.

    A suspect hull alone is no failure: real rigs that are a degree off have nothing else, and give a body.
    """
    stages = RunFolder(root).read_state().get("stages", {})
    code = OK
    for name, status, told in (
        ("hull", "suspect", "have a hull that is not to be trusted (see their problems in run.json)"),
        (stage, "failed", f"failed in stage {stage}"),
    ):
        frames = stages.get(name, {}).get("frames", {})
        those = sorted(k for k, entry in frames.items() if entry["status"] == status)
        if those:
            listed = ", ".join(those[:8]) + (f" and {len(those) - 8} more" if len(those) > 8 else "")
            print(f"bodyhull: {len(those)} of {len(frames)} frames {told}: {listed}", file=sys.stderr)
            code = FRAMES_FAILED if status == "failed" else code
    return code


def run(config: RunConfig, settings: FitSettings | None = None) -> int:
    """All stages in order; returns the exit code. settings: of the fit, where not the usual ones."""
    from bodyhull.carving import carve_stage
    from bodyhull.drawing import draw_stage
    from bodyhull.fitting import fit_stage

    started = time.perf_counter()
    carve_stage(config)
    fit_stage(config, settings)
    draw_stage(config)
    folder = RunFolder(config.out)
    films = sorted(folder.overlay("x").parent.glob("*.mp4"))
    print(f"fusion shape: {folder.fusion_mesh}")
    print(f"bodies:       {folder.mesh(0).parent}")
    print(
        f"overlay:      {films[0] if films else '-'}"
        + (f" and {len(films) - 1} more" if len(films) > 1 else "")
    )
    print(f"report:       {folder.report}   ({time.perf_counter() - started:.0f} s)")
    return frames_code(config.out, "fit")


def evaluate(command: Evaluate) -> int:
    """Compute, print and put into the report."""
    from bodyhull.carving import open_for
    from bodyhull.drawing import write_run_report
    from bodyhull.evaluating import error_text, evaluate_stage
    from bodyhull.fitting import load_track

    config = configuration_of(command.run)
    errors = evaluate_stage(config, command.truth)
    folder = RunFolder(command.run)
    if "render" in folder.read_state().get("stages", {}):
        write_run_report(config, open_for(config), load_track(folder))
    print(error_text(errors))
    return OK


def parsed_size(text: str) -> tuple[int, int]:
    """ "1024x768" as (width, height)."""
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError:
        raise UserError(f"--size {text}: give WIDTHxHEIGHT in pixels, for example 1024x1024") from None
    return width, height


def synthesise(command: Synth) -> int:
    """Film and tell where."""
    from fit.body.model import load_body
    from render.motions import MOTIONS
    from render.synthetic import film
    from render.wardrobe import OUTFITS

    for option, value, known in (("motion", command.motion, MOTIONS), ("garment", command.garment, OUTFITS)):
        if value not in known:
            raise UserError(f"--{option} {value}: there is no such {option}; there are: {', '.join(known)}")
    if command.frames < 1 or command.seed < 0:
        raise UserError(
            f"--frames {command.frames} --seed {command.seed}: at least 1 frame, and a seed of 0 or more"
        )
    truth = film(
        command.out,
        body=load_body(command.body),
        n_cameras=command.cameras,
        size=parsed_size(command.size),
        layout=command.layout,
        n_frames=command.frames,
        motion=command.motion,
        garment=command.garment,
        seed=command.seed,
        overwrite=command.overwrite,
    )
    print(f"recording: {command.out}\ntruth:     {truth}\nnext:      bodyhull run {command.out} --out RUN")
    return OK


def demo(command: Demo) -> int:
    """The main job on a synthetic recording, then the comparison with the truth."""
    recording, out = command.out / "recording", command.out / "run"
    started = time.perf_counter()
    synthesise(
        Synth(
            recording,
            frames=12,
            motion=command.motion,
            garment=command.garment,
            seed=command.seed,
            overwrite=True,
        )
    )
    code = run(RunConfig(recording, out, overwrite=True))
    if code != ERROR:
        evaluate(Evaluate(out, recording / "truth"))
    folder = RunFolder(out)
    print(f"overlay film: {sorted(folder.overlay('x').parent.glob('*.mp4'))[0]}")
    print(f"report:       {folder.report}")
    print(f"whole demo:   {time.perf_counter() - started:.0f} s")
    return code
