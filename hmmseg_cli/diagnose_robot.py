"""`hmmseg diagnose --simulator` and `--mjcf`: logs of any robot against its owner's own model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.table import Table

from hmmseg.errors import InputError
from hmmseg_cli.console import Output, check_folder
from simgap.report.finding import sentence
from simgap.report.finding import tables as usual_tables

if TYPE_CHECKING:
    from simgap.progress import Progress
    from simgap.robots.diagnose import RobotDiagnosis
    from simgap.simulators.mjcf.load import Loaded
    from simgap.simulators.protocol import Simulator
    from simgap.simulators.recording import Recording

ROBOT = "A robot against your own model of it"
SimulatorOption = Annotated[
    str | None,
    typer.Option(
        "--simulator",
        metavar="FILE.py:NAME",
        rich_help_panel="A robot against your own model of it",
        help="Your own model instead of the virtual blocks.",
    ),
]
MjcfOption = Annotated[
    Path | None,
    typer.Option(
        "--mjcf",
        metavar="XML",
        rich_help_panel="A robot against your own model of it",
        help="Your own model, as MuJoCo reads it; it needs --map.",
    ),
]
MapOption = Annotated[
    Path | None,
    typer.Option(
        "--map",
        metavar="MAP.toml",
        rich_help_panel="A robot against your own model of it",
        help="Which column of the logs is which joint, actuator, sensor "
        "or body of the MJCF model, in what unit.",
    ),
]
CandidateOption = Annotated[
    list[str] | None,
    typer.Option(
        "--candidate",
        metavar="NAME",
        rich_help_panel="A robot against your own model of it",
        help="Offer one more thing the MJCF model can set as a cause, such as joint:elbow.frictionloss.",
    ),
]
PatchOption = Annotated[
    Path | None,
    typer.Option("--patch", metavar="DIR", help="Write the corrected model and its ranges into this folder."),
]


@dataclass(frozen=True)
class OwnSimulator:
    """What the command line says of the owner's model."""

    simulator: str | None
    mjcf: Path | None
    map_file: Path | None
    candidates: Sequence[str]
    patch: Path | None

    @property
    def given(self) -> bool:
        """Whether a model was brought; InputError for what goes only with one."""
        if self.simulator is None and self.mjcf is None:
            if self.map_file is not None:
                raise InputError(f"--map {self.map_file}", "goes with a MuJoCo model", "--mjcf XML")
            if self.candidates:
                raise InputError(
                    f"--candidate {self.candidates[0]}", "goes with a MuJoCo model", "--mjcf XML"
                )
            return False
        if self.simulator is not None and self.mjcf is not None:
            raise InputError("--mjcf", "does not go with --simulator", "one model")
        if self.mjcf is not None and self.map_file is None:
            raise InputError(
                "--map", "missing", "which column is which joint, actuator or sensor of the model"
            )
        if self.mjcf is None and (self.map_file is not None or self.candidates):
            raise InputError(
                "--map" if self.map_file else "--candidate", "goes with a MuJoCo model", "--mjcf XML"
            )
        return True

    def check_alone(self, others: Mapping[str, Any]) -> None:
        """InputError for an option that has no meaning with the owner's model."""
        for option, value in others.items():
            if value:
                raise InputError(option, "does not go with a simulator of your own")
        if self.patch is not None:
            check_folder("--patch", self.patch)


def _read(
    out: Output, paths: Sequence[Path], own: OwnSimulator
) -> tuple[Simulator, list[Recording], Loaded | None]:
    """The simulator, the logs of its channels, and what was loaded of an MJCF."""
    if own.simulator is not None:
        from simgap.simulators.recording import read_recording
        from simgap.simulators.user import load_simulator

        loaded, simulator = None, load_simulator(own.simulator)
        commands = [name for name, channel in simulator.channels.items() if channel.kind == "command"]
        logs = [read_recording(path, list(simulator.channels), commands=commands) for path in paths]
    else:
        from simgap.simulators.mjcf.load import load_mjcf

        assert own.mjcf is not None and own.map_file is not None
        loaded = load_mjcf(own.mjcf, own.map_file, own.candidates)
        simulator, logs = loaded.simulator, [loaded.read(path) for path in paths]
    for warning in (*(() if loaded is None else loaded.warnings), *(w for log in logs for w in log.warnings)):
        out.warn(warning)
    return simulator, logs, loaded


@contextmanager
def _stages(out: Output, text: str, total: int) -> Iterator[Progress]:
    """Progress by stages, with what a long one is at; yields what is told of each stage that begins."""
    from simgap.progress import heard

    stage = text

    def tell(text: str) -> None:
        nonlocal stage
        stage = text
        advance(1, text)

    with out.progress(text, total=total) as advance, heard(lambda text: advance(0, f"{stage}: {text}")):
        yield tell


def _warn_of_engine(out: Output, own: OwnSimulator) -> None:
    """What MuJoCo warned of, each once."""
    if own.mjcf is not None:
        from simgap.simulators.mjcf.engine import warned

        for line in warned():
            out.warn(line)


def diagnose_robot(
    out: Output,
    paths: Sequence[Path],
    own: OwnSimulator,
    task: Path | None,
    effect: Sequence[str],
) -> None:
    """Read, diagnose, and put table, figures, page, patch and document where `out` has them go."""
    from simgap.robots.describe import body
    from simgap.robots.diagnose import STAGES, diagnose

    at_risk, recordings, loaded = _read(out, paths, own)
    more = [] if loaded is None else loaded.effects(recordings)
    length = None if loaded is None else loaded.map.length
    phases = None
    if task is not None:
        from hmmseg.io.task import read_task
        from simgap.robots.phases import phases_by_task

        phases = phases_by_task(recordings, read_task(task), f"--task {task}")
    with _stages(out, "diagnosing", STAGES) as tell:
        found = diagnose(
            at_risk,
            recordings,
            forced=tuple(dict.fromkeys(effect)),
            seed=out.seed,
            more=more,
            length=length,
            phases=phases,
            tell=tell,
            warn=out.warn,
        )
    document = body(found)
    _warn_of_engine(out, own)
    left = document["remainder"]["rms_over_noise"]
    out.print(sentence(document), f"What is left is {left:.3g} times the noise.", *tables(document, found))
    if out.figures is not None or out.report is not None:
        _draw(out, found, document)
    if own.patch is not None:
        from simgap.robots.patch import write_patch

        folder = own.patch
        given = found.composed, found.linear.point, document, document["causes"], own.mjcf
        if document["verdict"] == "unknown" and found.calibrated is not None:  # the best model there is
            whole, point = found.calibrated.composed, found.calibrated.point
            moved = [n for n in point if not whole.numeric(n)]
            given = whole, point, document["calibrated"], moved, own.mjcf
        write_patch(*given, lambda name: out.stage(folder / name))
        import json

        ranges, model = own.patch / "ranges.json", "" if own.mjcf is None else f" and {own.mjcf.name}"
        out.print(f"what was found is in {ranges}{model}")
        for line in json.loads(out.stage(ranges).read_text(encoding="utf-8")).get("not_in_xml", ()):
            out.warn(f"--patch: an MJCF has no place for {line}; correct the driver by ranges.json")
    out.finish(document)


def compare_robot(out: Output, paths: Sequence[Path], healthy: Sequence[Path], own: OwnSimulator) -> None:
    """What changed of a robot since its `healthy` logs: table, figure, page, patch and document."""
    from simgap.robot_effects import UNMEASURED, effects_of
    from simgap.robots.changes import STAGES, changes

    simulator, logs, loaded = _read(out, [*paths, *healthy], own)
    if loaded is None:
        effects = effects_of(simulator, logs)
    else:
        effects = effects_of(simulator, logs, loaded.effects(logs), (*UNMEASURED, *loaded.map.sd))
    with _stages(out, "comparing", STAGES) as tell:
        found = changes(simulator, logs[len(paths) :], logs[: len(paths)], effects, tell=tell)
    _warn_of_engine(out, own)
    document = found.body()
    for b in document["broken"]:
        out.warn(f"{b['trial']}: {b['channel']} is {b['value']:.4g} at {b['time']:.3f} s, left out")
    out.print(changed(document), *usual_tables(document))
    if out.figures is not None or out.report is not None:
        from hmmseg_cli.gap_figures import draw_changes

        if out.figures is not None:
            draw_changes(found, out.figure("changes.png"))
        if out.report is not None:
            from hmmseg_cli.pages import Setting, page

            shows = {n: e.says for n, e in effects.items()}
            setting = Setting(
                [log.name for log in logs[: len(paths)]], ["all"], shows=shows, warnings=out.warnings
            )
            text = page(document, setting, lambda path: draw_changes(found, path("gap_signal.png")))
            out.stage(out.report).write_text(text, encoding="utf-8")
    if own.patch is not None:
        from simgap.robots.patch import write_patch

        folder, causes = own.patch, document["causes"]
        point = {n: v for n, v in found.point().items() if not found.composed.numeric(n)}
        write_patch(found.composed, point, document, causes, own.mjcf, lambda name: out.stage(folder / name))
    out.finish(document)


def changed(document: Mapping[str, Any]) -> str:
    """The verdict on two sets of logs in a paragraph."""
    p = document["detection"]["p_value"]
    if document["verdict"] == "none":
        return "Nothing changed that these logs can tell: the new ones are met as the old ones are."
    if document["verdict"] == "unknown":
        best = "".join(f" The best that is known, {text}, leaves too much." for text in document["changes"])
        over = document["remainder"]["rms_over_noise"]
        return f"Something changed that no known cause explains: {over:.2g} times what old logs leave.{best}"
    lines = [f"Changed: {'; '.join(document['changes'])} (p = {p:.2g} that nothing did)."]
    if document["verdict"] == "set":
        others = ", ".join(document["indistinguishable"]) or "the same in other parts"
        lines.append(f"These logs cannot tell it from a change of {others}.")
    return " ".join(lines)


def tables(document: Mapping[str, Any], found: RobotDiagnosis) -> list[Table]:
    """What the logs cannot tell first, then the tables of every diagnosis, and held-out residuals."""
    out = []
    unseen = document["identifiability"]["unseen"]
    alike = document["identifiability"]["alike"]
    if unseen or alike:
        table = Table(title="what these logs cannot tell", title_justify="left", show_header=False)
        for one in alike[:6]:
            how = "act only together" if one["exact"] else f"are alike but for {100 * one['own']:.1f} %"
            table.add_row(", ".join(one["parameters"]), how)
        if unseen:
            table.add_row(", ".join(unseen[:8]), "cannot be seen")
        out.append(table)
    out += usual_tables(dict(document))
    if document["shrinkage"] is not None:
        rms = Table(title=f"residual on {document['shrinkage']['evaluated_on']}, rms", title_justify="left")
        for head in ("channel", "before", "after", "noise"):
            rms.add_column(head, justify="left" if head == "channel" else "right")
        for name, v in document["shrinkage"]["rms"].items():
            rms.add_row(
                f"{name} [{v['unit']}]",
                f"{v['before']:.4g}",
                f"{v['after']:.4g}",
                f"{found.composed.noise[name]:.2g}",
            )
        out.append(rms)
    return out


def _draw(out: Output, found: RobotDiagnosis, document: dict[str, Any]) -> None:
    """Figures where asked for, and the page with the same figures inside."""
    from hmmseg_cli.gap_figures import Drawn, draw_robot, draw_robot_page

    drawn = Drawn(found, document, found.warnings)
    if out.figures is not None:
        draw_robot(drawn, out.figure)
    if out.report is not None:
        from hmmseg_cli.pages import Setting, page

        setting = Setting(
            files=[r.name for r in found.composed.recordings],
            subtasks=sorted({cell["subtask"] for cell in document["where"]}),
            shows={n: e.says for n, e in found.composed.effects.items()},
            warnings=out.warnings,
        )
        text = page(document, setting, lambda path: draw_robot_page(drawn, path))
        out.stage(out.report).write_text(text, encoding="utf-8")
