"""`hmmseg play`: the virtual blocks in a browser, to be lifted, slid, stacked and dropped."""

from __future__ import annotations

import asyncio
import contextlib
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING

from hmmseg.errors import InputError
from hmmseg.io.rig import read_rig
from hmmseg.io.schema import read_json, read_toml
from hmmseg.io.task import BlockTask, read_task
from hmmseg.jaxconfig import configure
from hmmseg_cli import options as opt
from hmmseg_cli.console import Output, check_folder

if TYPE_CHECKING:
    from simgap.play.server import PlayServer
    from simgap.play.session import Session


def play(
    properties: opt.PlayedProperties = None, task: opt.PlayedTask = None, rig: opt.PlayedRig = None,
    blocks: opt.PlayedBlocks = None, effect: opt.PlayedEffect = None,
    output: opt.SavedFolder = Path("played"), port: opt.Port = 0, open_page: opt.OpenPage = True,
    json: opt.Json = None, seed: opt.Seed = 0, quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """The virtual blocks in a browser: the mouse holds the fingertips; a session is saved as a trial."""
    configure(steady=True)  # steps have a deadline, so they run in the calling thread
    check_folder("--output", output)
    with Output("play", json=json, seed=seed, quiet=quiet) as out:
        try:
            from simgap.play.server import PlayServer
        except ImportError:
            what = "needs the package websockets"
            raise InputError("hmmseg play", what, "pip install 'hmmseg[play]'") from None
        from simgap.play.world import effect_values

        effects = {} if properties is None else diagnosed(properties)
        session = _session(blocks if effects else properties, task, rig, seed)
        effects |= {name: effect_values(name) for name in effect or []}
        session.check_folder(output)
        out.print("preparing the blocks ...")
        if effects:
            session.compare_with(session.world_with(effects))
        server = PlayServer(session, output)
        with contextlib.suppress(KeyboardInterrupt):
            asyncio.run(_serve(out, server, port, open_page))
        out.finish({"saved": [str(path) for path in server.saved], "effects": effects})


async def _serve(out: Output, server: PlayServer, port: int, open_page: bool) -> None:
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
    """Effects and values from a diagnosis, none for other files; InputError if no cause of it can be felt."""
    from simgap.play.world import effect_values, felt_effects

    document = read_json(path, "identify's or diagnose's JSON") if path.suffix.lower() == ".json" else {}
    if not str(document.get("format", "")).startswith("hmmseg.diagnose/"):
        return {}
    where, causes = f"{path}: key causes", document.get("causes") or document.get("indistinguishable") or []
    if not isinstance(causes, list) or not causes:
        verdict = document.get("verdict")
        raise InputError(where, f"is empty (verdict {verdict})", "a diagnosis that names a cause")
    found = {}
    for name in causes:
        if name not in felt_effects():
            possible = f"one of {', '.join(felt_effects())}"
            raise InputError(where, f"{name} cannot be felt in a played world", possible)
        entry = (document.get("effects") or {}).get(name) or {}
        parameters = entry.get("parameters") if isinstance(entry, dict) else None
        means = {key: value["mean"] for key, value in (parameters or {}).items()
                 if isinstance(value, dict) and isinstance(value.get("mean"), int | float)}  # fmt: skip
        found[name] = effect_values(name, means)
    return found


def _session(properties: Path | None, task: Path | None, rig: Path | None, seed: int) -> Session:
    from simgap.play.session import Session, default_rig, default_task
    from simgap.world.properties import PAPER_BLOCKS, paper_blocks, read_properties

    description = None if task is None else read_task(task)
    hand = default_rig() if rig is None else read_rig(rig)
    if hand.gripper is not None:
        what = "a session is recorded with forces at both fingertips"
        raise InputError(f"{rig}: [gripper]", what, "a rig without")
    if description is None:
        description = default_task(list(PAPER_BLOCKS) if properties is None else _objects(properties))
    if not isinstance(description, BlockTask):
        raise InputError(str(task), "is a plain ordered task", "a task of blocks to play with")
    blocks = paper_blocks(description) if properties is None else read_properties(properties, description)
    return Session(description, hand, blocks, seed)


def _objects(path: Path) -> list[str]:
    """Names of the blocks in a file of properties."""
    expected = "identify's JSON or an actual.toml"
    from_json = path.suffix.lower() == ".json"
    table = read_json(path, expected).get("properties") if from_json else read_toml(path)
    if not isinstance(table, dict) or not table:
        raise InputError(str(path), "names no block", expected)
    return [str(name) for name in table]
