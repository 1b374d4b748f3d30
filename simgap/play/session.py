"""A session: one hand commands one or two worlds side by side, and is recorded."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from hmmseg.cache import write_whole
from hmmseg.errors import InputError
from hmmseg.io.rig import Rig
from hmmseg.io.task import BlockTask, parse_task
from simgap.play.world import STIFFNESS, PlayedWorld
from simgap.world.dynamics import CONTROL_PERIOD, interpolated
from simgap.world.properties import Blocks, lay_out
from simgap.world.simulate import record, scene_files, trial_csv

RATE = 100.0  # look: Hz; of the recording if the rig states none
CLEARANCE = 0.012  # look: m; opening of the hand in excess of the widest block
CLOSING = 0.1  # look: m/s; speed at which the hand closes and opens
FOLLOWING = 14.0  # look: 1/s; rate at which the command follows the mouse (critically damped)
FASTEST = 0.4  # look: m/s
LOWEST = 0.004  # look: m; lowest commanded fingertips above the ground
GRIP = 3.0  # look: N
LONGEST = 600.0  # limit: s of a recording


def default_rig() -> Rig:
    """Fingertips on foam pads as in the included recordings, recorded without joints."""
    pads = {"normal_stiffness": 4000.0, "shear_stiffness": 2500.0}
    noise = {"position": 2e-5, "velocity": 3e-3, "force": 0.01}
    return Rig.read({"rate": RATE, "fingertip": pads, "noise": noise})


def default_task(objects: list[str]) -> BlockTask:
    """All objects on the ground; the first is moved onto the second, or down again if there is none."""
    to = objects[1] if len(objects) > 1 else "ground"
    task = parse_task(
        {"objects": {name: {"on": "ground"} for name in objects}, "moves": [{"object": objects[0], "to": to}]}
    )
    assert isinstance(task, BlockTask)
    return task


class Session:
    """The nominal world, optionally a second one, and the hand that both follow. `aim` (the hand's middle,
    closed or open) or `touch` (each finger) sets the target, `advance` lets time pass, `frame` gives the
    current state, and `save` writes what was recorded since `reset`."""

    def __init__(self, task: BlockTask, rig: Rig, blocks: Blocks, seed: int = 0) -> None:
        self.task, self.rig, self.blocks, self.seed = task, rig, blocks, seed
        table = lay_out(task, blocks, 0.03, (0.0, 0.0), np.random.default_rng(seed))
        self.x = dict(table.x)
        self.open = max(block.width for block in blocks.values()) + CLEARANCE
        self.top = sum(block.height for block in blocks.values()) + 0.03
        middle = float(np.mean(list(self.x.values())))
        self.home = np.array([middle, self.top])
        start = np.array([[middle - self.open / 2, self.top], [middle + self.open / 2, self.top]])
        self.nominal = PlayedWorld(task, rig, blocks, self.x, start)
        self.other: PlayedWorld | None = None
        self.reset()

    def world_with(self, effects: Mapping[str, Mapping[str, float]]) -> PlayedWorld:
        """Another world with these effects, ready to run beside the nominal one."""
        return PlayedWorld(self.task, self.rig, self.blocks, self.x, self.nominal.start, effects)

    def compare_with(self, world: PlayedWorld | None) -> None:
        """Run another world beside the nominal one, or none; both restart."""
        self.other = world
        self.reset()

    @property
    def worlds(self) -> list[PlayedWorld]:
        """The nominal world, then the other where there is one."""
        return [self.nominal] if self.other is None else [self.nominal, self.other]

    def reset(self) -> None:
        """Return everything to the start; the recording restarts."""
        for world in self.worlds:
            world.reset()
        self.command, self.rate = self.nominal.start.copy(), np.zeros((2, 2))
        self.gap, self.grip, self.closed, self.speed = self.open, GRIP, False, np.zeros(2)
        self.target, self.fingers = self.home.copy(), None
        self._rows: list[np.ndarray] = []

    def aim(self, x: float, y: float, closed: bool, grip: float = GRIP) -> None:
        """Aim the hand's middle at x, y [m], closed with a grip [N] or open; ignored unless finite."""
        if np.isfinite([x, y, grip]).all():
            self.target = np.clip([x, y], [-0.2, LOWEST], [0.5, 0.4])
            self.closed, self.grip, self.fingers = bool(closed), float(np.clip(grip, 0.5, 8.0)), None

    def touch(self, places: np.ndarray) -> None:
        """Aim both fingers separately at places (2, 2) [m] of two touches; ignored unless finite."""
        if places.shape == (2, 2) and np.isfinite(places).all():
            ordered = places[np.argsort(places[:, 0])]
            self.fingers = np.clip(ordered, [-0.2, LOWEST], [0.5, 0.4])

    def advance(self, steps: int) -> None:
        """Advance by a number of milliseconds."""
        for _ in range(steps):
            self._follow()
            for world in self.worlds:
                world.advance(self.command, self.rate)
            if self.nominal.t < LONGEST:
                tips = self.nominal
                self._rows.append(np.concatenate([tips.position, tips.velocity, tips.force], axis=None))

    def _follow(self) -> None:
        """Let the command follow the mouse as a hand would: smoothly, with limited speed."""
        if self.fingers is not None:
            self.rate = self._drawn(self.fingers - self.command, self.rate)
            self.command = self.command + CONTROL_PERIOD * self.rate
            return
        tips, before = self.nominal.position, self.command
        between = float(tips[1, 0] - tips[0, 0])
        least = max(between - 2 * self.grip / STIFFNESS, 0.0) if self.closed else self.open
        step = CLOSING * CONTROL_PERIOD
        self.gap = float(np.clip(least, self.gap - step, self.gap + step))
        self.speed = self._drawn((self.target - before.mean(axis=0))[None], self.speed[None])[0]
        middle = before.mean(axis=0) + CONTROL_PERIOD * self.speed
        self.command = middle + np.array([[-self.gap / 2, 0.0], [self.gap / 2, 0.0]])
        self.rate = (self.command - before) / CONTROL_PERIOD

    @staticmethod
    def _drawn(way: np.ndarray, rate: np.ndarray) -> np.ndarray:
        """Rates (n, 2) [m/s] one millisecond later, given the remaining ways (n, 2) [m]."""
        rate = rate + CONTROL_PERIOD * (FOLLOWING**2 * way - 2 * FOLLOWING * rate)
        speed = np.linalg.norm(rate, axis=1, keepdims=True)
        return rate * np.minimum(1.0, FASTEST / np.maximum(speed, 1e-9))

    def scene(self) -> dict[str, Any]:
        """The constant part of the page: sizes of the blocks, and the other world's effect."""
        sizes = {name: [block.width, block.height, block.weight] for name, block in self.blocks.items()}
        effects = {} if self.other is None else self.other.effects
        return {"kind": "scene", "blocks": sizes, "effects": effects, "home": self.home.tolist(),
                "open": self.open, "stiffness": STIFFNESS}  # fmt: skip

    def frame(self) -> dict[str, Any]:
        """The current frame of the page."""
        worlds = [
            {"tips": world.position.tolist(), "force": world.felt.tolist(),
             "blocks": world.model.block_positions().tolist()}
            for world in self.worlds
        ]  # fmt: skip
        return {"kind": "frame", "t": self.nominal.t, "command": self.command.tolist(), "worlds": worlds}

    def save(self, folder: Path) -> list[Path]:
        """Save the nominal world's recording as the next trial_NN.csv, with rig, task and true properties,
        replacing nothing. ValueError if shorter than a second, InputError in another session's folder."""
        rows = np.array(self._rows)
        if len(rows) < 1000:
            raise ValueError("less than a second has been recorded")
        rate = self.rig.rate or RATE
        t = np.arange(int(len(rows) * CONTROL_PERIOD * rate)) / rate
        fine = np.arange(1, len(rows) + 1) * CONTROL_PERIOD
        at = interpolated(t, fine, rows.reshape(-1, 3, 2, 2))
        self.check_folder(folder)
        number = 1
        while (folder / f"trial_{number:02d}.csv").exists():
            number += 1
        rng = np.random.default_rng([self.seed, number])
        trial = record(t, at[:, 0], at[:, 1], at[:, 2], self.rig, rng, f"played {number}")
        texts = scene_files(self.task, self.rig, self.blocks) | {f"trial_{number:02d}.csv": trial_csv(trial)}
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            if not (folder / name).exists():
                write_whole(folder / name, text.encode())
        return [folder / name for name in texts]

    def check_folder(self, folder: Path) -> None:
        """InputError if the folder holds another session's rig, task or properties."""
        for name, text in scene_files(self.task, self.rig, self.blocks).items():
            there = folder / name
            if there.exists() and (not there.is_file() or there.read_bytes() != text.encode()):
                raise InputError(str(there), "is there already, and not this session's", "another --output")
