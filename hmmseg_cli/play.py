"""`hmmseg play`: the virtual blocks in a browser, to be lifted, slid, stacked and dropped."""

from __future__ import annotations

import asyncio
import contextlib
import json as jsonlib
import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from hmmseg.errors import InputError
from hmmseg.jaxconfig import configure
from hmmseg_cli.console import JsonOption, Output, QuietOption, SeedOption, check_folder

PropertiesArgument = Annotated[Path | None, typer.Argument(
    metavar="[PROPERTIES]", help="identify's or diagnose's JSON, or an actual.toml.")]  # fmt: skip
TaskFile = Annotated[Path | None, typer.Option("--task", metavar="T", help="How the blocks stand (TOML).")]
RigFile = Annotated[Path | None, typer.Option("--rig", metavar="R", help="Pads and recording (TOML).")]
BlocksFile = Annotated[Path | None, typer.Option(
    "--blocks", metavar="P", help="A diagnosis's blocks: identify's JSON or an actual.toml.")]  # fmt: skip
EffectOption = Annotated[list[str] | None, typer.Option(
    "--effect", metavar="NAME", help="Switched on in addition to the nominal world.")]  # fmt: skip
FolderOption = Annotated[Path, typer.Option("--output", metavar="DIR", help="Where trials are saved.")]
PortOption = Annotated[int, typer.Option("--port", min=0, max=65535, help="Port of the page; 0: any free.")]
OpenOption = Annotated[bool, typer.Option("--open/--no-open", help="Open the page in the browser.")]


def play(
    properties: PropertiesArgument = None, task: TaskFile = None, rig: RigFile = None,
    blocks: BlocksFile = None, effect: EffectOption = None, output: FolderOption = Path("played"),
    port: PortOption = 0, open_page: OpenOption = True, json: JsonOption = None, seed: SeedOption = 0,
    quiet: QuietOption = False,
) -> None:  # fmt: skip
    """The virtual blocks in a browser: the mouse holds the fingertips; a session is saved as a trial."""
    configure(steady=True)  # steps have a deadline, and are not handed to another thread
    check_folder("--output", output)
    with Output("play", json=json, seed=seed, quiet=quiet) as out:
        try:
            from simgap.play.server import PlayServer
        except ImportError:
            raise InputError(
                "hmmseg play", "needs the package websockets", "pip install 'hmmseg[play]'"
            ) from None
        from simgap.play.world import effect_values

        effects = {} if properties is None else diagnosed(properties)
        chosen = blocks if effects is not None and effects != {} else properties
        effects = (effects or {}) | {name: effect_values(name) for name in effect or []}
        session = _session(chosen, task, rig, seed)
        session.check_folder(output)
        out.print("preparing the blocks ...")
        if effects:
            session.compare_with(session.world_with(effects))
        server = PlayServer(session, output)
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(_serve(out, server, port, open_page))
        out.finish({"saved": [str(path) for path in server.saved], "effects": effects})


async def _serve(out: Output, server: Any, port: int, open_page: bool) -> None:
    try:
        address = await server.start(port)
    except OSError as error:
        raise InputError(f"--port {port}", f"cannot be listened to ({error.strerror})", "another") from None
    out.print(f"playing at {address} (Ctrl-C ends it)")
    if open_page:
        webbrowser.open(address)
    try:
        await asyncio.Event().wait()
    finally:
        await server.stop()


def diagnosed(path: Path) -> dict[str, dict[str, float]]:
    """Effects and their values as a diagnosis has them; none where it is no diagnosis.

    InputError where it names no cause, or only causes that cannot be felt.
    """
    from simgap.play.world import effect_values, felt_effects

    if path.suffix.lower() != ".json":
        return {}
    try:
        document = jsonlib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(str(path), "no such file", "identify's or diagnose's JSON") from None
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(str(path), f"not valid JSON ({error})") from None
    if not isinstance(document, dict) or not str(document.get("format", "")).startswith("hmmseg.diagnose/"):
        return {}
    causes = document.get("causes") or document.get("indistinguishable") or []
    if not isinstance(causes, list) or not causes:
        verdict = document.get("verdict")
        raise InputError(
            f"{path}: key causes", f"is empty (verdict {verdict})", "a diagnosis that names a cause"
        )
    found = {}
    for name in causes:
        if name not in felt_effects():
            raise InputError(f"{path}: key causes", f"{name} cannot be felt in a played world",
                             f"one of {', '.join(felt_effects())}")  # fmt: skip
        entry = (document.get("effects") or {}).get(name) or {}
        parameters = entry.get("parameters") if isinstance(entry, dict) else None
        means = {key: value["mean"] for key, value in (parameters or {}).items()
                 if isinstance(value, dict) and isinstance(value.get("mean"), int | float)}  # fmt: skip
        found[name] = effect_values(name, means)
    return found


def _session(properties: Path | None, task: Path | None, rig: Path | None, seed: int) -> Any:
    from hmmseg.io.rig import read_rig
    from hmmseg.io.task import BlockTask, read_task
    from simgap.play.session import Session, default_rig, default_task
    from simgap.world.properties import PAPER_BLOCKS, paper_blocks, read_properties

    description = None if task is None else read_task(task)
    if description is not None and not isinstance(description, BlockTask):
        raise InputError(str(task), "is a plain ordered task", "a task of blocks to play with")
    hand = default_rig() if rig is None else read_rig(rig)
    if hand.gripper is not None:
        raise InputError(
            f"{rig}: [gripper]", "a session is recorded with forces at both fingertips", "a rig without"
        )
    if description is None:
        description = default_task(list(PAPER_BLOCKS) if properties is None else _objects(properties))
    blocks = paper_blocks(description) if properties is None else read_properties(properties, description)
    return Session(description, hand, blocks, seed)


def _objects(path: Path) -> list[str]:
    """Names of the blocks in a file of properties."""
    if path.suffix.lower() == ".json":
        table = jsonlib.loads(path.read_text(encoding="utf-8"))
        table = table.get("properties") if isinstance(table, dict) else None
    else:
        from hmmseg.io.schema import read_toml

        table = read_toml(path)
    if not isinstance(table, dict) or not table:
        raise InputError(str(path), "names no block", "identify's JSON or an actual.toml")
    return [str(name) for name in table]
