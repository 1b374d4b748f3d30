"""`hmmseg simulate`: the virtual model performs a task, or replays a recording's motions."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hmmseg.contact.decompose import subtasks
from hmmseg.errors import InputError
from hmmseg.io.rig import FORCE_CHANNELS, Rig, read_rig
from hmmseg.io.task import BlockTask, read_task
from hmmseg.tables import listed
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_folder, read_trials

if TYPE_CHECKING:
    from hmmseg.segmentation.spans import Segmentation
    from simgap.world.animation import Scene, Traces
    from simgap.world.properties import Blocks
    from simgap.world.replay import Replay

    Films = Mapping[str, tuple[Scene, Traces]]  # by name what an animation shows


def simulate(
    task: opt.Task, rig: opt.Rig, properties: opt.Properties = None, replay: opt.Replay = None,
    trials: opt.Count = 1, output: opt.SimulatedFolder = Path("simulated"), operator: opt.Operator = None,
    animation: opt.Animated = False, animation_format: opt.AnimationFormat = "gif",
    json: opt.Json = None, figures: opt.Figures = None, seed: opt.Seed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Perform a task with the calibrated virtual model, or replay a recording through it."""
    check_folder("--output", output)
    with Output("simulate", json=json, figures=figures, seed=seed, quiet=quiet) as out:
        from simgap.patch import checked
        from simgap.world.animation import animate, require_encoder
        from simgap.world.properties import PAPER_BLOCKS, paper_blocks, read_properties
        from simgap.world.simulate import scene_files

        if animation:
            require_encoder(f".{animation_format}")
        description, hand = read_task(task), read_rig(rig)
        checked(hand.effects, str(rig))
        if not isinstance(description, BlockTask):
            raise InputError(str(task), "is a plain ordered task", "a task of blocks to simulate")
        if replay is not None and (trials != 1 or operator is not None):
            raise InputError("--replay", "goes with neither --trials nor --operator")
        blocks = paper_blocks(description) if properties is None else read_properties(properties, description)
        if properties is None and not set(description.objects) <= set(PAPER_BLOCKS):
            out.warn("no --properties: the task's objects are the paper's two blocks in turn")
        if replay is None:
            files, document, films = _perform(out, description, hand, blocks, trials, operator)
        else:
            files, document, films = _replay(out, replay, description, hand, blocks)
        files = scene_files(description, hand, blocks) | files
        targets = {(output / name).resolve() for name in files}
        for path in (task, rig, properties, replay, operator):
            if path is not None and path.resolve() in targets:
                raise InputError(f"--output {output}", f"would replace the input {path}", "another folder")
        for name, text in files.items():
            out.stage(output / name).write_text(text, encoding="utf-8")
        written = [output / name for name in files]
        for stem, film in films.items() if animation else ():
            written.append(output / f"{stem}.{animation_format}")
            animate(out.stage(written[-1]), *film)
        out.print(f"wrote {len(written)} files into {output}")
        properties_of = {name: asdict(block) for name, block in blocks.items()}
        out.finish({"properties": properties_of, "files": written, **document})


def _perform(
    out: Output, task: BlockTask, rig: Rig, blocks: Blocks, count: int, operator: Path | None
) -> tuple[dict[str, str], dict[str, Any], Films]:
    """Trials by the model's operator: files by name, their part of the document, and scenes to animate."""
    import numpy as np

    from simgap.patch import performed
    from simgap.world.animation import Scene
    from simgap.world.operator import OperatorSettings, read_operator
    from simgap.world.simulate import trial_files

    settings = OperatorSettings() if operator is None else read_operator(operator)
    seeds = [int(s) for s in np.random.SeedSequence(out.seed).generate_state(count)]
    files, rows, films = dict[str, str](), [], {}
    for k, simulated in enumerate(performed(task, rig, [blocks] * count, seeds, settings), 1):
        stem, t, force = f"trial_{k:02d}", simulated.t, simulated.motion.force
        files |= trial_files(k, simulated.trial, simulated.boundaries, simulated.seed)
        if not np.isfinite(simulated.boundaries).all():
            out.warn(f"{stem}: the task failed (a block was not lifted or was dropped)")
        elif out.figures is not None:
            simulated.plot(out.figure(f"{stem}_signals.png"))
        shown = {"Grip": np.minimum(force[:, 0, 0], -force[:, 1, 0]), "Net $f_y$": force[..., 1].sum(1),
                 "Net $f_x$": force[..., 0].sum(1)}  # fmt: skip
        traces = {f"{label} [N]": {"": (t, values)} for label, values in shown.items()}
        films[stem] = Scene(t, simulated.motion, {name: blocks[name] for name in task.objects}, rig), traces
        rows.append({"file": f"{stem}.csv", **simulated.to_json()})
    return files, {"trials": rows}, films


def _replay(
    out: Output, path: Path, task: BlockTask, rig: Rig, blocks: Blocks
) -> tuple[dict[str, str], dict[str, Any], Films]:
    """A recording's motions through the model: files, their part of the document, scenes to animate."""
    import numpy as np

    from hmmseg.io.trial import Trial
    from hmmseg.segmentation.align import segment
    from simgap.patch import replayed
    from simgap.world.animation import Scene
    from simgap.world.replay import residual_summary
    from simgap.world.simulate import trial_files

    recording = read_trials(out, [path], rig)[0]
    segmentation = segment([recording], task, rig)[0]
    if segmentation.failed is not None:
        out.warn(f"{recording.file}: {segmentation.failed}")
    boundaries = np.array([span.start for span in segmentation.spans[1:]])
    if len(boundaries) + 1 < len(subtasks(task)):
        raise InputError(recording.file, "does not show the whole task: some blocks have no place",
                         "a recording that `hmmseg segment` finds complete")  # fmt: skip
    result = replayed(recording, task, rig, blocks, boundaries)
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
    shown = (("Grip", "grip"), ("Net $f_y$", "fy"), ("Shear", "shear"))
    traces = {f"{label} [N]": {"recording": (signals.t, getattr(signals, key)),
                               "virtual model": (signals.t, model[key])} for label, key in shown}  # fmt: skip
    document = {"replay": {"file": str(path), "boundaries": boundaries, "complete": segmentation.complete,
                           "net_force_residual_over_noise": summary}}  # fmt: skip
    scene = Scene(result.t, result.motion, {name: blocks[name] for name in task.objects}, rig)
    return trial_files(1, predicted, boundaries, out.seed), document, {"trial_01": (scene, traces)}


def _draw_replay(result: Replay, segmentation: Segmentation, path: Path) -> None:
    """Plot measured and predicted grip, net and shear forces over coloured subtasks."""
    from hmmseg.plot.spans import stacked_panels
    from hmmseg.plot.style import BLUE, canvas

    signals, predicted = result.signals, result.predicted
    labels = {"grip": "Grip\n[N]", "fx": "Net $f_x$\n[N]", "fy": "Net $f_y$\n[N]", "shear": "Shear\n[N]"}
    panels = {"Distance\n[cm]": 100 * signals.distance}
    panels |= {label: getattr(signals, key) for key, label in labels.items()}
    with canvas(path, height=6.4) as figure:
        axes = stacked_panels(figure, signals.t, panels, segmentation)
        for ax, key in zip(axes[1:], labels, strict=True):
            ax.plot(signals.t, predicted[key], color=BLUE, lw=0.9, label="virtual model")
        axes[1].lines[0].set_label("recording")
        axes[1].set_ylim(top=1.4 * axes[1].get_ylim()[1])  # room for the legend
        axes[1].legend(handles=[axes[1].lines[0], axes[1].lines[-1]], loc="upper right", ncols=2)
