"""One answer of a watcher, and its line of JSON."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from hmmseg.contact.decompose import FREE, UNITS, Subtask
from hmmseg.segmentation.spans import Span

if TYPE_CHECKING:
    from hmmseg.online.filter import Filter

Z90, Z95 = 1.6448536269514722, 1.959963984540054  # physics: normal quantiles of central 90 and 95 %


@dataclass(frozen=True)
class Crossing:
    """A settled boundary: the subtask that begins, its round (from 0), and its time with sd [s]."""

    step: Subtask
    round: int
    t: float
    sd: float


class Answer:
    """State of a watcher after one row; read it before the next row.

    `t` [s]; `probabilities` (num_subtasks,) of the subtasks of one round; `departed`: probability that the
    recording has left its task; `smoothed`: as `probabilities`, at time t - lag; `properties`: (object,
    property, mean, sd).
    """

    note: str | None = None  # irregularity of the row, in words

    def __init__(self, watcher: Filter, t: float, final: bool) -> None:
        self._watcher, self.t, self.final, self.round = watcher, t, final, watcher.round
        self.probabilities, self.departed = watcher.now[:-1], float(watcher.now[-1])
        self.smoothed = watcher.smoothed[:-1]
        self._missed, self._left_at, state = watcher.departure
        self._contact = watcher.off_task[max(state, 0)]
        self.index = int(self.probabilities.argmax())
        if self.departed > 0.5:
            self.index = self._missed

    @property
    def fits(self) -> bool:
        """Whether the recording probably follows its task; at the end, whether it is complete."""
        w = self._watcher
        if self.departed > 0.5 or not self.final:
            return self.departed <= 0.5
        last_round = w.task.repeat == "unknown" or self.round + 1 == w.num_rounds
        return last_round and self.index == w.num_steps - 1

    @property
    def subtask(self) -> Subtask:
        """The most probable subtask; after a departure, the one that is missing."""
        return self._watcher.steps[self.index]

    @property
    def next(self) -> Subtask | None:
        """The task's next subtask; None at its end and after a departure."""
        w = self._watcher
        if self.departed > 0.5:
            return None
        if self.index + 1 < w.num_steps:
            return w.steps[self.index + 1]
        return w.steps[1] if w.cyclic and self.round + 1 < w.num_rounds else None

    @property
    def properties(self) -> list[tuple[str, str, float, float]]:
        """(object, property, mean, sd) of the properties known so far, SI units."""
        return self._watcher.properties.table(self._watcher.means)

    @property
    def failed(self) -> dict[str, Any] | None:
        """The subtask that the recording does not show, as in `segment`; None while it fits."""
        if self.fits:
            return None
        w = self._watcher
        if self.departed > 0.5:
            state, block = self._contact
            shown = state if state == FREE else f"{state} of {block or 'another block'}"
            step, reason = w.steps[self._missed], f"{shown} from {self._left_at:.2f} s on"
        else:
            k = min(self.index + 1, w.num_steps - 1)
            step, reason = w.steps[k], f"the recording ends in {self.subtask.name}"
        return {"index": step.index, "subtask": step.name, "object": step.object, "reason": reason}

    def line(self, more: dict[str, Any] | None = None) -> str:
        """One line of JSON, without its newline; `more`: further entries of the final line."""
        step = self.subtask
        w = self._watcher
        state = step.state if self.departed <= 0.5 else self._contact[0]
        probabilities = ["0" if p < 5e-7 else f"{p:.6f}" for p in self.probabilities.tolist()]
        parts = [
            f'{{"t":{self.t:.9g},"subtask":{_name(step.name)},"object":{_name(step.object)},"state":"{state}"',
            f'"probabilities":[{",".join(probabilities)}]',
            f'"next":{_step(self.next)}',
            f'"properties":{w.properties_text(self)}',
            f'"fits":{"true" if self.fits else "false"}',
            f'"departed":{_share(self.departed)}',
        ]
        if w.cyclic:
            parts.append(f'"repetition":{self.round + 1}')
        if not self.final:
            at = int(self.smoothed.argmax())
            then, p = w.steps[at], _share(float(self.smoothed[at]))
            parts.append(
                f'"smoothed":{{"t":{self.t - w.lag:.9g},"subtask":{_name(then.name)},'
                f'"object":{_name(then.object)},"probability":{p}}}'
            )
        if not self.fits:
            parts.append(f'"failed":{json.dumps(self.failed)}')
        if self.note is not None:
            parts.append(f'"note":{json.dumps(self.note)}')
        if self.final:
            parts += ['"final":true', f'"segments":{json.dumps(self.segments())}']
            parts += [f'"{key}":{json.dumps(value)}' for key, value in (more or {}).items()]
        return ",".join(parts) + "}"

    def properties_json(self) -> str:
        """The object `properties`, as text."""
        objects: dict[str, list[str]] = {}
        for name, prop, mean, sd in self.properties:
            objects.setdefault(name, []).append(
                f'"{prop}":{{"unit":"{UNITS[prop]}","mean":{mean:.6g},"sd":{sd:.3g},'
                f'"interval_95":[{mean - Z95 * sd:.6g},{mean + Z95 * sd:.6g}]}}'
            )
        return "{" + ",".join(f"{_name(name)}:{{{','.join(own)}}}" for name, own in objects.items()) + "}"

    def segments(self) -> list[dict[str, Any]]:
        """The spans so far, as in `segment`; the last one ends at this row."""
        w = self._watcher
        edges = [(w.first_t, 0.0), *((c.t, c.sd) for c in w.crossings), (self.t, 0.0)]
        out, steps = [], [w.steps[0], *(c.step for c in w.crossings)]
        for step, (start, sd), (end, end_sd) in zip(steps, edges, edges[1:], strict=False):
            end = max(start, end)
            start_90, end_90 = ((t - Z90 * s, t + Z90 * s) for t, s in ((start, sd), (end, end_sd)))
            span = Span(step.name, step.object, step.state, start, end, sd, end_sd, start_90, end_90)
            out.append(span.to_json())
        return out


def _share(p: float) -> str:
    return "0" if p < 5e-7 else ("1" if p > 1 - 5e-7 else f"{p:.6f}")


def _name(name: str | None) -> str:
    return json.dumps(name)


def _step(step: Subtask | None) -> str:
    if step is None:
        return "null"
    return f'{{"subtask":{_name(step.name)},"object":{_name(step.object)},"state":"{step.state}"}}'
