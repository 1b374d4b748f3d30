"""`hmmseg simulate`: the virtual model performs a task, or replays a recording's motions."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.tables import listed
from hmmseg_cli.console import (
    FiguresOption,
    JsonOption,
    Output,
    QuietOption,
    RigOption,
    SeedOption,
    TaskOption,
    check_folder,
    read_trials,
)


class Animation(StrEnum):
    """Kinds of animation."""

    GIF = "gif"
    MP4 = "mp4"


PropertiesOption = Annotated[Path | None, typer.Option(
    "--properties", metavar="P", help="identify's JSON or an actual.toml; else the paper's.")]  # fmt: skip
ReplayOption = Annotated[Path | None, typer.Option(
    "--replay", metavar="TRIAL", help="Drive the model with this recording's motions.")]  # fmt: skip
TrialsOption = Annotated[int, typer.Option("--trials", metavar="N", min=1, max=99, help="How many trials.")]
OutputOption = Annotated[Path, typer.Option("--output", metavar="DIR", help="Folder to write into.")]
OperatorOption = Annotated[Path | None, typer.Option(
    "--operator", metavar="FILE", help="How the operator works (TOML or JSON).")]  # fmt: skip
AnimationOption = Annotated[bool, typer.Option(
    "--animation", help="Draw fingers and blocks in motion next to the forces.")]  # fmt: skip
FormatOption = Annotated[Animation, typer.Option("--animation-format", help="Kind of animation.")]


def simulate(
    task: TaskOption, rig: RigOption, properties: PropertiesOption = None, replay: ReplayOption = None,
    trials: TrialsOption = 1, output: OutputOption = Path("simulated"), operator: OperatorOption = None,
    animation: AnimationOption = False, animation_format: FormatOption = Animation.GIF,
    json: JsonOption = None, figures: FiguresOption = None, seed: SeedOption = 0, quiet: QuietOption = False,
) -> None:  # fmt: skip
    """Perform a task with the calibrated virtual model, or replay a recording through it."""
    check_folder("--output", output)
    with Output("simulate", json=json, figures=figures, seed=seed, quiet=quiet) as out:
        from hmmseg.io.rig import read_rig
        from hmmseg.io.task import BlockTask, read_task
        from simgap.world.animation import require_encoder
        from simgap.world.properties import PAPER_BLOCKS, paper_blocks, read_properties
        from simgap.world.simulate import scene_files

        if animation:
            require_encoder(f".{animation_format.value}")
        description, hand = read_task(task), read_rig(rig)
        if hand.effects:
            from simgap.patch import checked

            checked(hand.effects, str(rig))
        if not isinstance(description, BlockTask):
            raise InputError(str(task), "is a plain ordered task", "a task of blocks to simulate")
        if replay is not None and (trials != 1 or operator is not None):
            raise InputError("--replay", "goes with neither --trials nor --operator")
        blocks = paper_blocks(description) if properties is None else read_properties(properties, description)
        if properties is None and not set(description.objects) <= set(PAPER_BLOCKS):
            out.warn("no --properties: the task's objects are the paper's two blocks in turn")
        films: list[tuple[str, Any, Any]] = []
        if replay is None:
            files, document = _perform(out, description, hand, blocks, trials, operator, seed, films)
        else:
            files, document = _replay(out, replay, description, hand, blocks, seed, films)
        files = scene_files(description, hand, blocks) | files
        _spare_inputs(output, files, [task, rig, properties, replay, operator])
        for name, text in files.items():
            out.stage(output / name).write_text(text, encoding="utf-8")
        written = [output / name for name in files]
        if animation:
            from simgap.world.animation import animate

            for stem, scene, traces in films:
                path = output / f"{stem}.{animation_format.value}"
                staged = out.stage(path).with_suffix(path.suffix)
                animate(staged, scene, traces)
                written.append(path)
        shown = {name: {"weight": b.weight, "width": b.width, "height": b.height, "friction": b.friction}
                 for name, b in blocks.items()}  # fmt: skip
        out.print(f"wrote {len(written)} files into {output}")
        out.finish({"properties": shown, "files": written, **document})


def _perform(out: Output, task, rig, blocks, count: int, operator, seed: int, films: list):
    """Trials by the model's own operator: files by name, and their part of the document."""
    import numpy as np

    from simgap.world.animation import Scene, Trace
    from simgap.world.operator import OperatorSettings, read_operator
    from simgap.world.simulate import simulate_trials, trial_files

    settings = OperatorSettings() if operator is None else read_operator(operator)
    seeds = [int(s) for s in np.random.SeedSequence(seed).generate_state(count)]
    if rig.effects:
        from simgap.patch import performed

        done = performed(task, rig, [blocks] * count, seeds, settings)
    else:
        done = simulate_trials(task, rig, [blocks] * count, seeds, settings)
    files, rows = {}, []
    for k, simulated in enumerate(done, 1):
        files |= trial_files(k, simulated.trial, simulated.boundaries, simulated.seed)
        if not np.isfinite(simulated.boundaries).all():
            out.warn(f"trial_{k:02d}: the task failed (a block was not lifted or was dropped)")
        if out.figures is not None and np.isfinite(simulated.boundaries).all():
            simulated.plot(out.figure(f"trial_{k:02d}_signals.png"))
        t, force = simulated.t, simulated.motion.force
        traces = [Trace("Grip [N]", [("", t, np.minimum(force[:, 0, 0], -force[:, 1, 0]))]),
                  Trace("Net $f_y$ [N]", [("", t, force[..., 1].sum(1))]),
                  Trace("Net $f_x$ [N]", [("", t, force[..., 0].sum(1))])]  # fmt: skip
        scene = Scene(t, simulated.motion.position, simulated.motion.blocks,
                      {name: blocks[name] for name in task.objects}, rig)  # fmt: skip
        films.append((f"trial_{k:02d}", scene, traces))
        rows.append({"file": f"trial_{k:02d}.csv", **simulated.to_json()})
    return files, {"trials": rows}


def _replay(out: Output, path: Path, task, rig, blocks, seed: int, films: list):
    """A recording's motions through the model: files by name, and their part of the document."""
    import numpy as np

    from hmmseg.contact.decompose import subtasks
    from hmmseg.io.rig import FORCE_CHANNELS
    from hmmseg.io.trial import Trial
    from hmmseg.segmentation.align import segment
    from simgap.world.animation import Scene, Trace
    from simgap.world.replay import replay, residual_summary
    from simgap.world.simulate import trial_files

    recording = read_trials(out, [path], rig)[0]
    segmentation = segment([recording], task, rig)[0]
    if segmentation.failed is not None:
        out.warn(f"{recording.file}: {segmentation.failed}")
    boundaries = np.array([span.start for span in segmentation.spans[1:]])
    if len(boundaries) + 1 < len(subtasks(task)):
        raise InputError(recording.file, "does not show the whole task: some blocks have no place",
                         "a recording that `hmmseg segment` finds complete")  # fmt: skip
    if rig.effects:
        from simgap.patch import replayed

        result = replayed(recording, task, rig, blocks, boundaries)
    else:
        result = replay(recording, task, rig, blocks, boundaries=boundaries)
    force = dict(zip(FORCE_CHANNELS, result.force.reshape(-1, 4).T, strict=True))
    predicted = Trial("trial_01.csv", recording.t, recording.channels | force)
    summary = {}
    if rig.noise.force is not None:
        summary = residual_summary(result, boundaries, [s.state for s in subtasks(task)])
        rows = [(state, f"{value:.2f}") for state, value in summary.items()]
        heads = ("state", "rms over sensor noise")
        out.print(listed("Net force, measured minus predicted", heads, rows, right=heads[1:]))
    if out.figures is not None:
        _draw_replay(result, segmentation, out.figure(f"{path.stem}_replay.png"))
    signals, model = result.signals, result.predicted
    traces = [Trace(f"{label} [N]", [("recording", signals.t, getattr(signals, key)),
                                     ("virtual model", signals.t, model[key])])
              for label, key in (("Grip", "grip"), ("Net $f_y$", "fy"), ("Shear", "shear"))]  # fmt: skip
    films.append(("trial_01", Scene(result.t, result.motion.position, result.motion.blocks,
                                    {name: blocks[name] for name in task.objects}, rig), traces))  # fmt: skip
    document = {"replay": {"file": str(path), "boundaries": boundaries, "complete": segmentation.complete,
                           "net_force_residual_over_noise": summary}}  # fmt: skip
    return trial_files(1, predicted, boundaries, seed), document


def _spare_inputs(folder: Path, names, inputs) -> None:
    """InputError where writing would replace a file that was read."""
    targets = {(folder / name).resolve() for name in names}
    for path in inputs:
        if path is not None and Path(path).resolve() in targets:
            raise InputError(f"--output {folder}", f"would replace the input {path}", "another folder")


def _draw_replay(result, segmentation, path: Path) -> None:
    """Grip, net and shear forces measured and predicted, over coloured subtasks."""
    from hmmseg.plot.spans import Panel, stacked_panels
    from hmmseg.plot.style import BLUE, canvas

    signals, predicted = result.signals, result.predicted
    panels = [
        Panel("Distance\n[cm]", 100 * signals.distance),
        Panel("Grip\n[N]", signals.grip),
        Panel("Net $f_x$\n[N]", signals.fx),
        Panel("Net $f_y$\n[N]", signals.fy),
        Panel("Shear\n[N]", signals.shear),
    ]
    with canvas(path, height=6.4) as figure:
        axes = stacked_panels(figure, signals.t, panels, segmentation)
        curves = (predicted["grip"], predicted["fx"], predicted["fy"], predicted["shear"])
        for ax, values in zip(axes[1:], curves, strict=True):
            ax.plot(signals.t, values, color=BLUE, lw=0.9, label="virtual model")
        axes[1].lines[0].set_label("recording")
        axes[1].set_ylim(top=1.4 * axes[1].get_ylim()[1])  # room for the legend
        axes[1].legend(handles=[axes[1].lines[0], axes[1].lines[-1]], loc="upper right", ncols=2)
