"""Benchmark of the virtual model in a haptic loop: its rate on one core, and its passivity.

    python -m experiments.benchmarks.haptic_loop [--seconds 60] [--realtime] [--output FILE.json]

Rate: two blocks are picked and stacked repeatedly at 4 kHz, with every step timed on one core and memory
monitored, and compared with loops at the same pace that do nothing, or arithmetic for as long as a step
takes; these show the machine's own latency. With `--realtime` it runs as a haptic loop would, paced by the
clock and with priority over all other processes; without it, as fast as possible. Passivity: a light device,
squeezed onto a block by a spring, feels forces that are held for a period and one sample old; port energy and
remaining motion over a range of pad stiffness, at 1 and 4 kHz, without and with passivity control, against
the sampled-data limit.
"""

from __future__ import annotations

import argparse
import gc
import itertools
import os
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np

from experiments.saving import save
from experiments.table_text import markdown
from hmmseg.io.rig import Fingertip, Rig
from hmmseg.io.task import GROUND, BlockTask, Move
from hmmseg.jaxconfig import configure
from simgap.world.properties import PAPER_BLOCKS
from simgap.world.simulate import simulate_trials
from simgap.world.virtual_model import Surroundings, VirtualModel, _program

TASK = BlockTask({"block1": "block2", "block2": GROUND}, (Move("block1", GROUND), Move("block2", "block1")))
PADS = Fingertip(normal_stiffness=4000.0, shear_stiffness=2500.0)
RATES = (1000.0, 4000.0)  # Hz
STIFFNESS = (1000.0, 2000.0, 4000.0, 8000.0, 16e3, 32e3, 64e3, 128e3, 256e3)  # N/m
FOAM_TIMES = (0.0, 2e-3)  # s; damping over stiffness of the virtual pads
DEVICE_MASS, DEVICE_DAMPING = 0.1, 2.0  # kg, N s/m, of one fingertip
HAND_STIFFNESS, SQUEEZE = 150.0, 0.01  # N/m and m: the operator closes by 1.5 N


def measure_rate(seconds: float, paced: bool, rate: float = 4000.0) -> dict[str, float]:
    """Times of all steps [us] over `seconds` at a rate, and the growth of memory [bytes]."""
    done = simulate_trials(TASK, Rig(fingertip=PADS), [PAPER_BLOCKS], [0])[0]
    places = {name: float(done.motion.blocks[0, k, 0]) for k, name in enumerate(TASK.objects)}
    model = VirtualModel(Rig(fingertip=PADS), TASK, PAPER_BLOCKS, places)
    t = np.arange(0, done.t[-1], 1 / rate)
    column = lambda z: np.stack([np.interp(t, done.t, c) for c in z.reshape(len(z), -1).T], 1)  # noqa: E731
    position, velocity = column(done.motion.position), column(done.motion.velocity)
    model.prepare(1 / rate)
    steps = round(seconds * rate)

    def step(k: int) -> None:
        row = k % len(t)
        if row == 0:
            model.reset()
        model.step(position[row], velocity[row], 1 / rate)

    compiled = _program.cache_info().misses
    wall, busy = _timed(step, steps, rate, paced)
    empty, _ = _timed(lambda k: None, steps, rate, paced)
    compiled = _program.cache_info().misses - compiled
    spin = _spin(float(np.median(busy)))
    spinning, _ = _timed(lambda k: spin(), steps, rate, paced)
    grown = _growth(model, position, velocity, 1 / rate)
    return {
        "steps": steps, "mean_us": wall.mean(), "median_us": float(np.median(wall)),
        "p99_us": float(np.percentile(wall, 99)), "p99_9_us": float(np.percentile(wall, 99.9)),
        "worst_us": wall.max(), "late": int((wall > 1e6 / rate).sum()),
        "processor_median_us": float(np.median(busy)), "processor_p99_9_us": float(np.percentile(busy, 99.9)),
        "processor_worst_us": busy.max(), "processor_late": int((busy > 1e6 / rate).sum()),
        "spinning_loop_p99_9_us": float(np.percentile(spinning, 99.9)),
        "spinning_loop_worst_us": spinning.max(),
        "spinning_loop_late": int((spinning > 1e6 / rate).sum()),
        "empty_loop_worst_us": empty.max(), "empty_loop_late": int((empty > 1e6 / rate).sum()),
        "rate_hz": 1e6 / wall.mean(), "programs_compiled_in_the_loop": compiled,
        "grown_bytes_in_10000_steps": grown,
    }  # fmt: skip


def _spin(micro: float) -> Callable[[], object]:
    """Arithmetic without memory access that takes about the given processor time [us]."""
    work = lambda n: sum(range(n))  # noqa: E731
    began = time.thread_time_ns()
    for _ in range(1000):
        work(1000)
    number = round(1000 * micro / ((time.thread_time_ns() - began) * 1e-6))
    return lambda: work(number)


def _timed(
    step: Callable[[int], None], steps: int, rate: float, paced: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Wall and processor time [us] of every step; garbage is not collected meanwhile."""
    wall, busy = np.zeros(steps), np.zeros(steps)
    gc.collect()
    gc.freeze()
    gc.disable()
    start = time.perf_counter()
    for k in range(steps):
        if paced:
            time.sleep(max(0.0, start + k / rate - time.perf_counter()))
        used, begin = time.thread_time_ns(), time.perf_counter()
        step(k)
        wall[k], busy[k] = time.perf_counter() - begin, time.thread_time_ns() - used
    gc.enable()
    return 1e6 * wall, 1e-3 * busy


def _growth(model: VirtualModel, position: np.ndarray, velocity: np.ndarray, dt: float) -> int:
    """Growth of Python's memory [bytes] from one thousand to ten thousand steps."""
    held = []
    tracemalloc.start()
    for k in range(11_000):
        model.step(position[k], velocity[k], dt)
        if k in (1000, 10_999):
            gc.collect()
            held.append(tracemalloc.get_traced_memory()[0])
    tracemalloc.stop()
    return held[1] - held[0]


# Passivity of a haptic loop: an observer of the port's energy and a controller that damps.
#
# The device holds each rendered force for a whole period, and the force is a sample old: a stiff
# virtual contact then returns more energy than it took. Port energy is counted exactly, as held
# force times displacement, and whatever was returned too much is dissipated at once by damping
# (passivity observer and controller: Hannaford & Ryu, IEEE Trans. Robotics Autom. 18, 2002).


def stiffest_passive(damping: float, period: float, delay: float) -> float:
    """Stiffness [N/m] up to which a sampled spring on a damped device is passive without control.

    damping > stiffness (period / 2 + delay), the sampled-data condition of Colgate & Schenkel,
    J. Robotic Systems 14 (1997), with the computation's delay [s] added to the hold's half period;
    `damping` [N s/m] is the device's own.
    """
    return damping / (period / 2 + delay)


class PassivityControl:
    """Bounds the energy that a virtual scene returns through the fingers by what it absorbed.

    Call `render` once a period with what the model asks for. `energy` [J] is what the scene has
    taken up through the port so far; `allowed` [J] is what it may return beyond that (what blocks
    and springs held at the start).
    """

    def __init__(self, period: float, allowed: float = 0.0, limit: float = 50.0) -> None:
        self.period, self.allowed, self.limit = period, allowed, limit
        self.energy = 0.0
        self._held, self._moved = np.zeros(4), np.zeros(4)
        self._place: np.ndarray | None = None

    def render(self, force: np.ndarray, position: np.ndarray) -> np.ndarray:
        """Force (2, 2) [N] on the scene to hold for the next period; the device feels its opposite.

        `force` (2, 2) [N] is the model's, `position` (2, 2) [m] the fingers' now. Damping brakes
        with at most `limit` [N s/m], the device's own bound, beyond cancelling a push.
        """
        here = np.reshape(position, 4)
        moved = np.zeros(4) if self._place is None else here - self._place
        coming = 2 * moved - self._moved  # the fingers' next displacement if they keep accelerating
        self._place, self._moved = here.copy(), moved
        self.energy += float(self._held @ moved)
        out = np.reshape(force, 4).astype(float)
        expected = self.energy + float(out @ coming) + self.allowed
        travel = float(coming @ coming)
        if expected < 0.0 and travel > 0.0:
            # Up to the device's own bound, or as much as takes away the push along the motion.
            most = max(self.limit / self.period, -float(out @ coming) / travel)
            out = out + min(-expected / travel, most) * coming
        self._held = out
        return out.reshape(2, 2)


def squeeze(
    rate: float, stiffness: float, foam_time: float, controlled: bool, seconds: float = 1.0
) -> dict[str, float]:
    """A device squeezed onto a block: largest energy the port returned [J], speed left at the end [m/s]."""
    period, substeps = 1 / rate, 8
    pads = Fingertip(normal_stiffness=stiffness, shear_stiffness=stiffness * 0.6)
    model = VirtualModel(Rig(fingertip=pads), TASK, PAPER_BLOCKS, {"block1": 0.12, "block2": 0.12},
                         Surroundings(pad_time=foam_time))  # fmt: skip
    control = PassivityControl(period)
    height = 0.0127 + 0.008
    width = PAPER_BLOCKS["block1"].width
    place = np.array([[0.12 - width / 2 - 0.001, height], [0.12 + width / 2 + 0.001, height]])
    aim = np.array([[0.12 - width / 2 + SQUEEZE, height], [0.12 + width / 2 - SQUEEZE, height]])
    speed, waiting = np.zeros((2, 2)), np.zeros((2, 2))
    energy, returned, speeds = 0.0, 0.0, []
    for _ in range(round(seconds * rate)):
        force = model.step(place, speed, period)
        # One sample of delay: the model's current output is rendered a period later.
        held, waiting = waiting, force
        if controlled:
            held = control.render(held, place)
        before = place.copy()
        for _ in range(substeps):
            pull = HAND_STIFFNESS * (aim - place) - DEVICE_DAMPING * speed - held
            speed = speed + period / substeps / DEVICE_MASS * pull
            place = place + period / substeps * speed
        energy += float((held * (place - before)).sum())
        returned = max(returned, -energy)
        speeds.append(float(np.abs(speed).max()))
    return {"returned_J": returned, "speed_left": max(speeds[-round(0.2 * rate):])}  # fmt: skip


def measure_passivity() -> list[dict[str, float | bool]]:
    """The squeeze over rates and stiffnesses, without and with control."""
    rows = []
    for rate in RATES:
        limit = stiffest_passive(DEVICE_DAMPING, 1 / rate, 1 / rate)
        for foam_time, stiffness, controlled in itertools.product(FOAM_TIMES, STIFFNESS, (False, True)):
            found = squeeze(rate, stiffness, foam_time, controlled)
            rows.append({"rate": rate, "foam_time": foam_time, "stiffness": stiffness,
                         "controlled": controlled, "sampled_data_limit": limit, **found})  # fmt: skip
    return rows


def table(found: dict) -> str:
    """docs/virtual_model.md: the haptic loop and one that does nothing."""
    rate = found["rate"]
    rows = [
        ["two blocks", f"{rate['median_us']:.0f} µs", f"{rate['p99_9_us']:.0f} µs",
         f"{rate['worst_us'] / 1e3:.2f} ms", f"{rate['late']} of {rate['steps']:,}"],
        ["as long, spinning", "", f"{rate['spinning_loop_p99_9_us']:.0f} µs",
         f"{rate['spinning_loop_worst_us'] / 1e3:.2f} ms", f"{rate['spinning_loop_late']}"],
        ["empty", "", "", f"{rate['empty_loop_worst_us'] / 1e3:.2f} ms", f"{rate['empty_loop_late']}"],
    ]  # fmt: skip
    note = (
        f"Programs compiled in the loop: {rate['programs_compiled_in_the_loop']}; bytes grown in 10,000 "
        f"steps: {rate['grown_bytes_in_10000_steps']} (the interpreter's own)."
    )
    return markdown(["loop", "median", "99.9 %", "worst", "late"], rows) + f"\n\n{note}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Rate and passivity of the virtual model in a haptic loop.")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the timed run")
    parser.add_argument("--output", type=Path, default=Path("experiments/results/haptic_loop.json"))
    parser.add_argument("--realtime", action="store_true", help="real-time priority (Linux, with the right)")
    options = parser.parse_args()
    configure(steady=True)
    os.sched_setaffinity(0, {max(os.sched_getaffinity(0))})
    if options.realtime:  # before the first computation: its threads inherit the priority
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
    rate = measure_rate(options.seconds, paced=options.realtime) | {"realtime": options.realtime}
    if options.realtime:
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    result = {"rate": rate, "passivity": measure_passivity()}
    save(options.output, result)
    for key, value in result["rate"].items():
        print(f"{key:28s} {value:12.1f}")
    print("rate  stiffness  foam [s]  limit  control  returned [J]  speed left [m/s]")
    for row in result["passivity"]:
        numbers = (row[key] for key in ("rate", "stiffness", "foam_time", "sampled_data_limit", "controlled"))
        print("{:5.0f} {:9.0f} {:8.3f} {:7.0f} {!s:>7}".format(*numbers), end=" ")
        print(f"{row['returned_J']:12.2e} {row['speed_left']:10.4f}")


if __name__ == "__main__":
    main()
