"""The command line as the README tells it: names, defaults, help, awkward values."""

import re
from pathlib import Path

import pytest

import bodyhull
from bodyhull import cli
from bodyhull.config import RunConfig
from tests.command_line import call

Capture = pytest.CaptureFixture[str]
RUN = (
    "RECORDING --out --sequence --body --calibration --frames --voxel-mm --units --up --background "
    "--keypoints --pose-prior --no-colours --votes --soft --no-find-faults --refine --overwrite "
)
FIT = (
    "--labels --preset --lambda-skin --lambda-outside --lambda-fit --lambda-cpl --lambda-prior --lambda-shape"
)
COMMANDS = {
    "run": RUN + FIT,
    "carve": RUN + FIT,
    "fit": "RUN --out --body --keypoints --pose-prior --frames --units --up --overwrite " + FIT,
    "overlay": "RUN --overwrite",
    "evaluate": "RUN --truth",
    "ground-truth": "--out --body",
    "synth": "OUT --cameras --size --layout --frames --motion --garment --seed --body --overwrite",
    "body info": "FILE",
    "body convert": "FILE OUT.npz --overwrite",
    "body show": "FILE --out --sheet",
    "rig-study": "--out --layout --calibration --size --units --up --cameras --widths --calibration-px "
    "--mask-px --base-cameras --base-width --frames --motion --garment --seed --body --hull-only "
    "--jobs --overwrite",
    "convert": "IN OUT --to --units --size --undistorted --invert-poses --overwrite",
    "calibrate boards": "IN --out --squares --square-mm --board --marker-mm --dictionary --floor --lenses "
    "--intrinsics-only --wide --every",
    "calibrate refine": "RECORDING --out --keypoints --focal --sequence --calibration --frames --units --up "
    "--background",
    "calibrate world": "RECORDING --out --floor --height-m --keypoints --sequence --calibration --frames "
    "--units --up --background",
    "silhouettes": "RECORDING --out --method --background --key --refine --no-repair --as-filmed --pictures "
    "--calibration --sequence --frames --units --jobs --overwrite",
    "check": "RECORDING --out --sample --calibration --sequence --frames --units --up --background",
    "doctor": "",
    "demo": "--out --seed --motion --garment",
}


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Commands that would have been carried out."""
    seen: list[object] = []

    def note(command: object) -> int:
        seen.append(command)
        return 0

    monkeypatch.setattr(cli, "perform", note)
    return seen


@pytest.mark.parametrize("command", COMMANDS)
def test_help_names_every_option(command: str, capsys: Capture) -> None:
    said = call(capsys, *command.split(), "--help")
    assert said.code == 0
    documented = set(COMMANDS[command].split())
    for name in documented:
        assert re.search(rf"(^|[\s│]){re.escape(name)}\b", said.out, re.MULTILINE), (
            f"{name} is missing from the help"
        )
    found = set(re.findall(r"^[│ ]{1,3}(--[a-z][a-z-]*)", said.out, re.MULTILINE)) - {"--help"}
    assert found == {name for name in documented if name.startswith("--")}


def test_help_lists_the_commands(capsys: Capture) -> None:
    said = call(capsys, "--help")
    assert said.code == 0
    assert all(re.search(rf"^[│ •]+{name.split()[0]} ", said.out, re.MULTILINE) for name in COMMANDS), (
        said.out
    )
    assert bodyhull.__doc__ is not None and bodyhull.__doc__.split(":")[0] in said.out


def test_options_arrive_in_the_configuration(taken: list[object], capsys: Capture) -> None:
    call(
        capsys, "run", "rec", "--out", "there", "--sequence", "walk", "--body", "free:male",
        "--calibration", "c.json", "--frames", "0:100:5", "--voxel-mm", "5", "--units", "mm", "--up", "-y",
        "--background", "plates", "--keypoints", "openpose", "--overwrite",
        "--pose-prior", "prior.npz", "--no-colours", "--votes", "2", "--soft", "--no-find-faults", "--refine",
    )  # fmt: skip
    assert taken == [
        cli.Run(
            Path("rec"), Path("there"), "walk", "free:male", Path("c.json"), "0:100:5", 5.0, "mm", "-y",
            Path("plates"), Path("openpose"), True, Path("prior.npz"), False, 2, True, False, True,
        )
    ]  # fmt: skip


def test_defaults_are_stated_once(taken: list[object], capsys: Capture) -> None:
    call(capsys, "carve", "rec", "--out", "there")
    config = RunConfig(Path("rec"), Path("there"))
    assert vars(taken[0]) == vars(config)
    assert (config.body, config.voxel_mm, config.units, config.up) == ("free:neutral", 8.0, "auto", "auto")


@pytest.mark.parametrize("axis", ["auto", "x", "y", "z", "-x", "-y", "-z"])
def test_an_axis_may_begin_with_a_sign(axis: str, taken: list[object], capsys: Capture) -> None:
    call(capsys, "run", "rec", "--up", axis, "--out", "there")
    call(capsys, "run", f"--up={axis}", "rec", "--out", "there")
    assert [command.up for command in taken] == [axis, axis]  # type: ignore[attr-defined]


def test_frames_may_begin_with_a_sign(taken: list[object], capsys: Capture) -> None:
    call(capsys, "run", "rec", "--frames", "-10::2", "--out", "there")
    assert taken[0].frames == "-10::2"  # type: ignore[attr-defined]
    assert cli.joined_signs(["--up", "--out", "a"]) == ["--up", "--out", "a"], "an option is no value"


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ((), "run|synth"),
        (("walk",), "walk"),
        (("run", "rec"), "--out"),
        (("run", "--out", "there"), "RECORDING"),
        (("run", "rec", "--out", "there", "--units", "inch"), "inch"),
        (("run", "rec", "--out", "there", "--up", "w"), "w"),
        (("run", "rec", "--out", "there", "--voxel-mm", "fine"), "fine"),
        (("run", "rec", "--out", "there", "--sped-up"), "--sped-up"),
        (("evaluate", "there"), "--truth"),
    ],
)
def test_misuse_is_told_with_code_two(words: tuple[str, ...], what: str, capsys: Capture) -> None:
    said = call(capsys, *words)
    assert said.code == 2
    assert re.search(what, said.err + said.out) and "Traceback" not in said.err


def test_the_version_is_in_one_place() -> None:
    root = Path(__file__).parent.parent
    changelog = (root / "CHANGELOG.md").read_text("utf-8")
    newest = re.search(r"^## (\S+), \d{4}-\d{2}-\d{2}$", changelog, re.MULTILINE)
    assert newest is not None and newest[1] == bodyhull.__version__


def test_the_readme_tells_every_command_and_option() -> None:
    readme = (Path(__file__).parent.parent / "README.md").read_text("utf-8")
    for command, options in COMMANDS.items():
        assert f"bodyhull {command}" in readme, command
        missing = [name for name in options.split() if f"{name}" not in readme]
        assert not missing, f"the README does not tell {missing} of {command}"
