"""`hmmseg diagnose`: where the sim-to-real gap lies, what causes it, how far it shrinks."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg_cli.console import (
    ActualOption,
    FiguresOption,
    JsonOption,
    Output,
    QuietOption,
    ReportOption,
    SeedOption,
    TrialsArgument,
    check_folder,
    distinct_trials,
    read_trials,
)
from hmmseg_cli.diagnose_robot import (
    CandidateOption,
    MapOption,
    MjcfOption,
    OwnSimulator,
    PatchOption,
    SimulatorOption,
    diagnose_robot,
)
from simgap.report.finding import sentence
from simgap.report.tables import tables

if TYPE_CHECKING:
    from simgap.gap.diagnose import Diagnosis

EffectOption = Annotated[
    list[str] | None,
    typer.Option(
        "--effect", metavar="NAME", help="Take this effect instead of choosing; several act together."
    ),
]
RigFile = Annotated[
    Path | None,
    typer.Option("--rig", metavar="R", help="Nominal hand (TOML); a plain ordered task needs none."),
]
AgainstOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--against",
        metavar="SIM",
        help="Simulated trials to compare with instead of the virtual model, up to the next option. "
        "A plain ordered task needs them.",
    ),
]
ModelFile = Annotated[
    Path | None,
    typer.Option(
        "--model",
        metavar="M",
        help="A robot's own model, as MuJoCo reads it (it needs --map), or the emissions (.npz) of a plain "
        "ordered task, from hmmseg fit.",
    ),
]
HealthyOption = Annotated[
    list[Path] | None,
    typer.Option(
        "--healthy",
        metavar="TRIAL",
        help="Recordings known to be healthy, the best null there is, up to the next option; "
        "healthy twins are simulated otherwise.",
    ),
]
TaskFile = Annotated[
    Path | None,
    typer.Option(
        "--task", metavar="T", help="Task description (TOML); not needed with --simulator or --mjcf."
    ),
]
LISTS = ("--against", "--healthy")  # options that take several files


def with_options_repeated(args: list[str]) -> list[str]:
    """Arguments with `--against A B` written `--against A --against B`, as the parser takes one a time; the
    same of `--healthy`."""
    out: list[str] = []
    taking = ""
    for arg in args:
        if arg.startswith("-"):
            taking = arg if arg in LISTS else ""
        elif taking and out[-1] != taking:
            out.append(taking)
        out.append(arg)
    return out


def diagnose(
    trials: TrialsArgument,
    task: TaskFile = None,
    rig: RigFile = None,
    actual: ActualOption = None,
    effect: EffectOption = None,
    against: AgainstOption = None,
    model: ModelFile = None,
    healthy: HealthyOption = None,
    simulator: SimulatorOption = None,
    mjcf: MjcfOption = None,
    map_file: MapOption = None,
    candidate: CandidateOption = None,
    patch: PatchOption = None,
    json: JsonOption = None,
    figures: FiguresOption = None,
    report: ReportOption = None,
    seed: SeedOption = 0,
    quiet: QuietOption = False,
) -> None:
    """The sim-to-real gap: where it lies, which unmodelled effect causes it, how far it shrinks."""
    with Output("diagnose", json=json, figures=figures, report=report, seed=seed, quiet=quiet) as out:
        paths = distinct_trials(trials)
        if model is not None and mjcf is None and model.suffix.lower() != ".npz":
            model, mjcf = None, model  # a robot's, not the emissions of a task
        own = OwnSimulator(simulator, mjcf, map_file, candidate or [], patch)
        if own.given:
            own.check_alone({"--rig": rig, "--actual": actual, "--against": against, "--model": model})
            diagnose_robot(out, paths, own, task, effect or [])
            return
        if task is None:
            raise InputError("--task", "missing", "the task's description, or --simulator or --mjcf")
        description = read_task(task)
        if against and patch is not None:
            raise InputError("--patch", "does not go with --against: no rig.toml is diagnosed")
        if against:
            if healthy:
                raise InputError("--healthy", "does not go with --against: those are the null")
            _against(out, paths, against, description, rig, actual, effect or [], model)
            return
        if not isinstance(description, BlockTask):
            raise InputError(str(task), "a plain ordered task has no virtual model", "--against SIM")
        if model is not None:
            raise InputError(f"--model {model}", "goes only with a plain ordered task")
        if rig is None:
            raise InputError("--rig", "missing", "the nominal hand of a task of blocks")
        from hmmseg.io.rig import read_rig

        hand = read_rig(rig)
        if patch is not None:
            check_folder("--patch", patch)
        found = run(out, paths, description, hand, actual, effect or [], healthy or [])
        if patch is not None:
            _patch(out, found, rig, patch)
        out.finish(found.body)


def _patch(out: Output, found: Diagnosis, rig: Path, folder: Path) -> None:
    """Write the corrected model; a warning where there is no cause to correct, or where it predicts worse."""
    from simgap.patch import files, reproduced

    if (folder / "rig.toml").resolve() == rig.resolve():
        raise InputError(f"--patch {folder}", f"would replace the input {rig}", "another folder")
    frame = found.problem.frame
    written = files(rig.read_text(encoding="utf-8"), found.body)
    if not written:
        out.warn(f"--patch {folder}: no cause was named, so there is nothing to correct; nothing is written")
        return
    nominal, corrected = reproduced(written, found.body, found.search.trials, frame.task, frame.rig)
    text = f"forces differ from the recorded ones by {corrected:.3g} N with it, {nominal:.3g} N without"
    if not corrected < nominal:
        out.warn(f"--patch {folder}: the corrected model is no better ({text}); nothing is written")
        return
    for name, text in written.items():
        out.stage(folder / name).write_text(text, encoding="utf-8")
    out.print(f"the corrected model is in {folder}: {', '.join(written)}; {text}")


def run(
    out: Output,
    paths: Sequence[Path],
    task: BlockTask,
    rig: Rig,
    actual: Path | None,
    effect: Sequence[str],
    healthy: Sequence[Path] = (),
) -> Diagnosis:
    """Diagnose, and put table, figures and page where `out` has them go."""
    from estimation.actual import read_actual
    from hmmseg.segmentation.align import align
    from simgap.gap.diagnose import STAGES
    from simgap.gap.diagnose import diagnose as find

    measured = None if actual is None else read_actual(actual, task.objects)
    recordings = read_trials(out, paths, rig)
    well = read_trials(out, distinct_trials(list(healthy)), rig) if healthy else []
    with out.progress("diagnosing", total=STAGES) as advance:
        tell = lambda text: advance(1)  # noqa: E731
        found = find(
            align(recordings, task, rig), measured, effect, out.seed, tell,
            healthy=align(well, task, rig) if well else None,
        )  # fmt: skip
    for warning in found.warnings:
        out.warn(warning)
    pads = rig.fingertip.model_dump()
    out.print(sentence(found.body, pads), *tables(found.body))
    _draw(out, found, recordings, task, rig, measured)
    return found


def _against(
    out: Output, paths, against, task, rig_file, actual, effect: list[str], model_file: Path | None
) -> None:
    """The generic diagnosis, against given simulated trials."""
    from simgap.generic.diagnose import diagnose as compare
    from simgap.generic.diagnose import diagnose_blocks

    if actual is not None:
        raise InputError(f"--actual {actual}", "does not go with --against: no properties are fitted")
    every = distinct_trials([*paths, *against])
    with out.progress("diagnosing", total=4) as advance:
        tell = lambda text: advance(1)  # noqa: E731
        if isinstance(task, BlockTask):
            from hmmseg.io.rig import read_rig

            if rig_file is None:
                raise InputError("--rig", "missing", "the nominal hand of a task of blocks")
            if model_file is not None:
                raise InputError(f"--model {model_file}", "goes only with a plain ordered task")
            hand = read_rig(rig_file)
            read = read_trials(out, every, hand)
            real, sim = read[: len(paths)], read[len(paths) :]
            found = diagnose_blocks(real, sim, task, hand, effect, out.seed, tell)
        else:
            from hmmseg.sequence.model import load_model

            read = read_trials(out, every, task=task)
            learned = None if model_file is None else load_model(model_file, task)
            found = compare(read[: len(paths)], read[len(paths) :], task, learned, effect, out.seed, tell)
    for warning in found.warnings:
        out.warn(warning)
    out.print(sentence(found.body), *tables(found.body))
    _draw_against(out, found, [trial.name for trial in read[: len(paths)]], task)
    out.finish(found.body)


def _draw_against(out: Output, found, files: Sequence[str], task) -> None:
    """Figures and page of a diagnosis against given simulated trials."""
    if out.figures is None and out.report is None:
        return
    from hmmseg_cli.figures.gap_generic import draw_signal
    from simgap.generic.effects import EFFECTS

    shows = {name: candidate.shows for name, candidate in EFFECTS.items()}
    _show(out, found.body, files, task, lambda path: draw_signal(found, path), shows=shows)


def _draw(out: Output, found, recordings, task: BlockTask, rig: Rig, measured) -> None:
    """Figures and page of a diagnosis against the virtual model."""
    if out.figures is None and out.report is None:
        return
    from hmmseg_cli.figures.gap_signal import draw_signal
    from simgap.effects import catalogue

    shows = {name: effect.shows for name, effect in catalogue().items()}
    files = [trial.name for trial in recordings]
    pads = rig.fingertip.model_dump()
    _show(out, found.body, files, task, lambda path: draw_signal(found, path), pads, measured, shows)


def _show(
    out: Output,
    body: dict[str, Any],
    files: Sequence[str],
    task,
    signal: Callable[[Path], None],
    pads: dict[str, float] | None = None,
    measured=None,
    shows: dict[str, str] | None = None,
) -> None:
    """Figures where asked for, and the page, from the body alone; `signal` draws the recorded one."""
    from hmmseg.contact.decompose import subtasks
    from hmmseg_cli.gap_report import Setting, page
    from simgap.report.figures import draw_all, draw_how_far

    names = list(dict.fromkeys(s.label for s in subtasks(task)))

    def draw(path: Callable[[str], Path]) -> None:
        signal(path("gap_signal.png"))
        if body.get("shrinkage") and body["shrinkage"].get("before") is not None:
            draw_how_far(body, path("gap_before_after.png"))

    if out.figures is not None:
        draw_all(body, names, out.figure)
        signal(out.figure("gap_signal.png"))
    if out.report is not None:
        setting = Setting(files, names, pads or {}, measured, shows or {}, out.warnings)
        out.stage(out.report).write_text(page(body, setting, draw), encoding="utf-8")
