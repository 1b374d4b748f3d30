"""Tasks of the check: what stands on what, which block goes where, and the file that says so."""

from __future__ import annotations

from dataclasses import dataclass

GROUND = "ground"


@dataclass(frozen=True)
class Task:
    """`on`: what every block stands on at the start; `moves`: (block, where it goes), in order."""

    name: str
    on: dict[str, str]
    moves: tuple[tuple[str, str], ...]

    @property
    def subtasks(self) -> tuple[str, ...]:
        """Names as the diagnosis has them; what is before a later move belongs to the one before."""
        first = self.moves[0][0]
        steps = ("pickup", "carry", "place", "release")
        return (f"pregrasp {first}", *(f"{s} {b}" for b, _ in self.moves for s in steps))

    def toml(self) -> str:
        """The task.toml."""
        objects = "".join(f'[objects.{b}]\non = "{on}"\n' for b, on in self.on.items())
        moves = "".join(f'[[moves]]\nobject = "{b}"\nto = "{to}"\n' for b, to in self.moves)
        return objects + moves


TASKS = {
    task.name: task
    for task in (
        Task(
            "reversal",
            {"block1": "block2", "block2": GROUND},
            (("block1", GROUND), ("block2", "block1")),
        ),
        Task("transport", {"block1": GROUND}, (("block1", GROUND),)),
        Task("stacking", {"block1": GROUND, "block2": GROUND}, (("block1", "block2"),)),
        Task(
            "there_and_back",
            {"block1": "block2", "block2": GROUND},
            (("block1", GROUND), ("block1", "block2")),
        ),
        Task(
            "tower",
            {"block1": "block2", "block2": "block3", "block3": GROUND},
            (("block1", GROUND), ("block2", "block1"), ("block3", "block2")),
        ),
    )
}
