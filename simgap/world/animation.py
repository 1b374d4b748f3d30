"""Animation of fingers and blocks beside their force traces, as a GIF or an MP4."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.animation import FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from hmmseg.errors import InputError
from hmmseg.hand.kinematics import inverse
from hmmseg.io.rig import Rig
from hmmseg.plot.style import BLUE, GREY, INK, OTHER_COLOURS, STYLE
from simgap.world.dynamics import Record
from simgap.world.properties import Block

FRAMES = 15.0  # look: frames per second, in real time
SIZE, DPI = (9.0, 3.8), 90  # look: inches, dots per inch
PAD = (0.003, 0.008)  # numerics: m; drawn width and height of a fingertip
WRITERS = {".gif": PillowWriter, ".mp4": FFMpegWriter}


# Panels of forces over time by label, each of curves (t [s], values) by name.
Traces = Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]


@dataclass(frozen=True)
class Scene:
    """A motion to draw, at times t (T,) [s]; blocks by name, in the motion's order."""

    t: np.ndarray
    motion: Record
    blocks: dict[str, Block]
    rig: Rig


def animate(path: Path, scene: Scene, traces: Traces) -> None:
    """Write the animation to `path`, in real time; InputError for another suffix or without ffmpeg."""
    if path.suffix not in WRITERS:
        raise InputError(str(path), f"unknown kind of animation {path.suffix!r}", " or ".join(WRITERS))
    require_encoder(path.suffix)
    with matplotlib.rc_context(STYLE):
        figure = Figure(figsize=SIZE, layout="constrained")
        stage, *panels = figure.subplot_mosaic(
            [["scene", label] for label in traces], width_ratios=(1.0, 1.0)
        ).values()
        bodies, pads, links = _draw_scene(stage, scene)
        clock = stage.text(0.02, 0.97, "", transform=stage.transAxes, va="top")
        cursors = _draw_traces(panels, scene, traces)
        joints, writer = _joints(scene), WRITERS[path.suffix](fps=FRAMES)
        figure.draw_without_rendering()
        figure.set_layout_engine("none")  # laid out once; then artists only move
        rows = np.searchsorted(scene.t, np.arange(scene.t[0], scene.t[-1], 1 / FRAMES))
        with writer.saving(figure, str(path), DPI):
            for k in np.minimum(rows, len(scene.t) - 1):
                for body, (x, y) in zip(bodies, 100 * scene.motion.blocks[k], strict=True):
                    body.set_xy((x - body.get_width() / 2, y - body.get_height() / 2))
                for finger, pad in enumerate(pads):
                    x, y = 100 * scene.motion.position[k, finger]
                    pad.set_xy((x - (100 * PAD[0] if finger == 0 else 0.0), y - 50 * PAD[1]))
                for line, chain in zip(links, joints, strict=True):
                    line.set_data(*(100 * chain[k].T))
                clock.set_text(f"{scene.t[k]:.1f} s")
                for cursor in cursors:
                    cursor.set_xdata([scene.t[k]] * 2)
                writer.grab_frame()


def require_encoder(suffix: str) -> None:
    """InputError if an animation of this suffix cannot be written on this machine."""
    if suffix == ".mp4" and not FFMpegWriter.isAvailable():
        raise InputError("--animation mp4", "the program ffmpeg is not installed", "gif, or ffmpeg")


def _draw_scene(stage: Axes, scene: Scene) -> tuple[list[Rectangle], list[Rectangle], list[Line2D]]:
    """Draw ground, blocks, pads and links; the artists that move."""
    seen = np.concatenate([scene.motion.position.reshape(-1, 2), scene.motion.blocks.reshape(-1, 2)])
    left, right = scene.motion.position[..., 0].min(), scene.motion.position[..., 0].max()
    near = 100 * seen[(seen[:, 0] > left - 0.1) & (seen[:, 0] < right + 0.1)]  # without far blocks
    (left, _), (right, top) = near.min(axis=0), near.max(axis=0)
    stage.set(xlim=(left - 2, right + 2), ylim=(-0.4, top + 2), aspect="equal")
    stage.set(xlabel="x [cm]", ylabel="y [cm]")
    stage.axhline(0.0, color=INK, lw=1.0)
    bodies = list[Rectangle]()
    for k, (name, block) in enumerate(scene.blocks.items()):
        body = Rectangle((0, 0), 100 * block.width, 100 * block.height, facecolor=OTHER_COLOURS[k % 7],
                         edgecolor=INK, lw=0.6, alpha=0.8, label=name)  # fmt: skip
        stage.add_patch(body)
        bodies.append(body)
    pads = [Rectangle((0, 0), 100 * PAD[0], 100 * PAD[1], facecolor=GREY, edgecolor=INK, lw=0.6)
            for _ in range(2)]  # fmt: skip
    for pad in pads:
        stage.add_patch(pad)
    links = [stage.plot([], [], "o-", color=INK, lw=1.6, ms=3.5, alpha=0.5)[0]
             for _ in range(2 if scene.rig.jointed else 0)]  # fmt: skip
    stage.legend(loc="upper right", ncols=len(bodies))
    return bodies, pads, links


def _joints(scene: Scene) -> list[np.ndarray]:
    """Chains (T, 3, 2) [m] of base, elbow and wrist of both fingers of a jointed hand."""
    chains = []
    for i in (1, 2) if scene.rig.jointed else ():
        finger = scene.rig.finger(i)
        q = inverse(finger, i, scene.motion.position[:, i - 1])
        base = np.broadcast_to(np.asarray(finger.base), (len(q), 2))
        elbow = base + finger.links[0] * np.stack([np.cos(q[:, 0]), np.sin(q[:, 0])], -1)
        chains.append(np.stack([base, elbow, scene.motion.position[:, i - 1]], 1))
    return chains


def _draw_traces(panels: Sequence[Axes], scene: Scene, traces: Traces) -> list[Line2D]:
    """Draw all traces; the lines that mark the current time."""
    cursors = []
    for panel, (label, curves) in zip(panels, traces.items(), strict=True):
        for k, (name, curve) in enumerate(curves.items()):
            panel.plot(*curve, color=(INK, BLUE)[k % 2], lw=0.9, label=name or None)
        panel.set(xlim=(scene.t[0], scene.t[-1]), ylabel=label)
        cursors.append(panel.axvline(scene.t[0], color=GREY, lw=0.8))
        panel.tick_params(labelbottom=panel is panels[-1])
    if panels[0].get_legend_handles_labels()[1]:
        panels[0].set_ylim(top=1.45 * panels[0].get_ylim()[1])  # room for the legend
        panels[0].legend(loc="upper right", ncols=2)
    panels[-1].set_xlabel("Time [s]")
    return cursors
