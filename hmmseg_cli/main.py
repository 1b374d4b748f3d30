"""The `hmmseg` command and its exit codes.

0: done, whatever was found. 2: the input is at fault, as one line on standard error says, or the machine
refuses (memory, a disk). Any other exception is a bug and shows its traceback.
"""

import _thread
import contextlib
import gc
import os
import sys
import threading
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

import typer

import hmmseg
from hmmseg.errors import InputError
from hmmseg.jaxconfig import configure
from hmmseg_cli import demo, describe, diagnose, identify, inspect, play, robot, run, segment, simulate, watch
from hmmseg_cli.console import Grouped, Hmmseg, discard, escape_control

# numerics: objects between two garbage collections: most belong to modules and compilers, and stay anyway
COLLECTED = 10_000

# `typer` no longer exposes (nor, since it carries its own copy, depends on) click's base class.
UsageError: type[Exception] = typer.BadParameter.__mro__[1]

# Plain help: markup would swallow text in square brackets.
app = typer.Typer(cls=Hmmseg, rich_markup_mode=None, context_settings={"help_option_names": ["-h", "--help"]})

# In the order of `hmmseg --help`, each with an example. Modules import what is heavy (jax, matplotlib,
# pandas) inside their command, so that help and light commands start at once.
COMMANDS = {
    "Begin": {
        demo.demo: "hmmseg demo",
        inspect.new: "hmmseg new my_hand --from trial_01.csv",
        inspect.inspect: "hmmseg inspect trial_01.csv",
        describe.decompose: "hmmseg decompose task.toml",
        describe.doctor: "hmmseg doctor",
    },
    "When and what": {
        segment.segment: "hmmseg segment trial_*.csv --figures figures/",
        identify.identify: "hmmseg identify trial_*.csv --report report.html",
        watch.watch: "robot --csv | hmmseg watch --task task.toml --rig rig.toml",
        segment.fit: "hmmseg fit trial_*.csv --labels labels/ --model model.npz",
    },
    "Why simulation and recording differ": {
        robot.calibrate: "hmmseg calibrate log_*.csv --mjcf robot.xml --map map.toml --patch corrected/",
        diagnose.diagnose: diagnose.EXAMPLES,
        describe.effects: "hmmseg effects",
    },
    "The virtual blocks": {
        simulate.simulate: "hmmseg simulate --task task.toml --rig rig.toml --properties result.json",
        play.play: "hmmseg play result.json",
    },
}
for _group, _commands in COMMANDS.items():
    for _command, _example in _commands.items():
        app.command(
            cls=getattr(_command, "cls", Grouped),
            short_help=(_command.__doc__ or "").strip().partition("\n\n")[0],  # in full, not cut short
            epilog=_example,
            rich_help_panel=_group,
        )(_command)  # type: ignore[type-var]


def _show_version(wanted: bool) -> None:
    if wanted:
        print(hmmseg.__version__)
        raise typer.Exit


@app.callback()
def _hmmseg(
    version: Annotated[
        bool, typer.Option("--version", is_eager=True, callback=_show_version, help="Show the version.")
    ] = False,
) -> None:
    """Identify an object's weight, width, height and friction from what a robot hand felt."""


AGAIN = 0.02  # numerics: s until an interrupt is repeated; the callback has usually returned by then


@contextlib.contextmanager
def repeat_interrupts() -> Iterator[None]:
    """Lose no interrupt: one that arrives while a compiler calls back into Python is repeated here."""
    usual, waiting = sys.unraisablehook, []

    def hook(unraisable: Any) -> None:
        if not issubclass(unraisable.exc_type, KeyboardInterrupt):
            usual(unraisable)
            return
        waiting.append(threading.Timer(AGAIN, _thread.interrupt_main))
        waiting[-1].start()

    sys.unraisablehook = hook
    try:
        yield
    finally:
        sys.unraisablehook = usual
        for timer in waiting:
            timer.cancel()


def main(args: Sequence[str] | None = None) -> int:
    """Run the command line and return its exit code (0 or 2; 130 when interrupted)."""
    gc.set_threshold(COLLECTED, *gc.get_threshold()[1:])
    configure()
    _open_streams()
    args = list(sys.argv[1:] if args is None else args) or ["--help"]
    command = typer.main.get_command(app)
    try:
        with repeat_interrupts():
            code = command.main(args, prog_name="hmmseg", standalone_mode=False) or 0
            sys.stdout.flush()
            return code
    except InputError as error:
        return _at_fault(str(error))
    except MemoryError:
        return _at_fault("hmmseg: there is not enough memory for this; expected shorter or fewer recordings")
    except OSError as error:  # a disk that is full, a folder that is gone: the machine, not a bug
        return _at_fault(f"{error.filename or 'standard output'}: {error.strerror or error}")
    except UsageError as error:
        context = getattr(error, "ctx", None)
        path = context.command_path if context else "hmmseg"
        message = error.format_message().partition("Traceback (most recent call last)")[0]  # type: ignore[attr-defined]
        return _at_fault(f"{path}: {message.strip() or 'a value that cannot be read'} (see {path} --help)")
    except typer.Abort:
        return 130


def _at_fault(line: str) -> int:
    with contextlib.suppress(OSError, ValueError):
        print(escape_control(" ".join(line.split())), file=sys.stderr)
    try:
        sys.stdout.flush()
    except (OSError, ValueError):
        discard(sys.stdout)
    return 2


def _open_streams() -> None:
    """Replace closed streams, and let names that are not UTF-8 be printed."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:
            setattr(sys, name, open(os.devnull, encoding="utf-8"))  # noqa: SIM115 - to read from alone
        elif hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    if sys.stdin is None:
        sys.stdin = open(os.devnull, encoding="utf-8")  # noqa: SIM115


if __name__ == "__main__":
    run()
