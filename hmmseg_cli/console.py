"""What all commands share: help, input files, results on screen and in files, warnings.

A command opens an `Output` before it reads anything, so that unwritable destinations are reported before the
work. Files are staged and put in place together by `Output.finish`; a command that fails writes nothing.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json as jsonlib
import math
import os
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.segment import Segment
from typer.core import TyperCommand, TyperGroup

import hmmseg
from hmmseg.cache import CacheWarning
from hmmseg.errors import InputError
from hmmseg.io.formats import KINDS, kind_of, parts_of, split_part
from hmmseg.io.schema import read_toml

STANDARD_OUTPUT = "-"
INPUT_SUFFIXES = (*KINDS, ".toml")


class Grouped(TyperCommand):
    """A command whose help groups its options by purpose and ends with examples."""

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Options, in the groups that their declarations name."""
        kinds = {"argument": "Arguments", "option": "Options"}
        rows = ((getattr(p, "rich_help_panel", None) or kinds[p.param_type_name], p.get_help_record(ctx))
                for p in self.get_params(ctx))  # fmt: skip
        _write_groups(formatter, rows)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Examples, as typed."""
        if self.epilog:
            with formatter.section("Example" if "\n" not in self.epilog else "Examples"):
                formatter.write("".join(f"  {line}\n" for line in self.epilog.splitlines()))


class Hmmseg(TyperGroup):
    """The command whose help groups its subcommands by purpose."""

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Commands, in the groups that `main` names."""
        commands: list[Any] = [self.get_command(ctx, name) for name in self.list_commands(ctx)]
        rows = ((c.rich_help_panel, (c.name, c.get_short_help_str(formatter.width))) for c in commands)
        _write_groups(formatter, rows)


def _write_groups(formatter: Any, rows: Iterable[tuple[str, tuple[str, str] | None]]) -> None:
    groups: dict[str, list[tuple[str, str]]] = {}
    for title, row in rows:
        if row is not None:  # a hidden option has none
            groups.setdefault(title, []).append(row)
    for title, own in groups.items():
        with formatter.section(title):
            formatter.write_dl(own)


class Output:
    """Destinations of one command's results. `figure` and `stage` return paths to write to, and `finish` puts
    everything in place. InputError at once if one cannot be written."""

    def __init__(self, command: str, *, json: str | None = None, figures: Path | None = None,
                 report: Path | None = None, seed: int = 0, quiet: bool = False) -> None:  # fmt: skip
        self.command, self.seed = command, seed
        self.json, self.figures, self.report = json, figures, report
        self.warnings: list[str] = []
        self._drawn: list[Path] = []
        self._staged: dict[Path, Path] = {}
        self._cleanup = contextlib.ExitStack()
        if json not in (None, STANDARD_OUTPUT):
            check_file("--json", Path(json), refused=INPUT_SUFFIXES)
        if report is not None:
            check_file("--report", report, suffixes=(".html", ".htm"))
        if figures is not None:
            check_folder("--figures", figures)
        only_json = json == STANDARD_OUTPUT
        self._console = _console(sys.stderr if only_json else sys.stdout, quiet)
        self._side = _console(sys.stderr, quiet)

    def __enter__(self) -> Output:
        self._folder = self._cleanup.enter_context(scratch())
        self._stdout = sys.stdout
        self._cleanup.enter_context(warnings.catch_warnings())
        usual = warnings.showwarning

        def show(message: Any, category: Any, *where: Any) -> None:
            if issubclass(category, CacheWarning):
                self.warn(str(message))
            else:
                usual(message, category, *where)

        warnings.showwarning = show  # type: ignore[assignment]
        if self.json == STANDARD_OUTPUT:  # stray prints must not spoil the document
            self._cleanup.enter_context(contextlib.redirect_stdout(sys.stderr))
        return self

    def __exit__(self, *exception: object) -> None:
        self._cleanup.close()

    def print(self, *renderables: Any, whole: bool = False) -> None:
        """Show tables or text, on standard error if `--json -` takes standard output; `whole`: unwrapped."""
        for renderable in renderables:
            with self._console.unless_lost():
                self._console.print(renderable, highlight=False, markup=False, soft_wrap=whole)

    def warn(self, *texts: str) -> None:
        """Keep warnings for the JSON document, and show them on standard error."""
        for text in texts:
            self.warnings.append(text)
            with self._side.unless_lost():
                self._side.print(f"warning: {text}", highlight=False, markup=False, soft_wrap=True)

    def write(self, text: str) -> None:
        """Write text to standard output unchanged."""
        with self._console.unless_lost(self._stdout):
            self._stdout.write(text)
            self._stdout.flush()

    @property
    def lost(self) -> str:
        """Why nothing can be written any more; empty while it can."""
        return self._console.lost

    @contextlib.contextmanager
    def progress(self, text: str, total: int, timed: bool = True) -> Iterator[Callable[..., None]]:
        """A progress bar on standard error; yields a function that advances it and may set its text.

        `timed`: the bar tells the time left, by the speed of its latest steps.
        """
        from rich.progress import Progress

        columns = Progress.get_default_columns()[: None if timed else -1]
        with Progress(
            *columns, console=self._side, transient=True, disable=not self._side.is_terminal
        ) as bar:
            task = bar.add_task(text, total=total)
            yield lambda steps, now=text: bar.update(task, advance=steps, description=now)

    def figure(self, name: str) -> Path:
        """Path to draw the figure of this file name to; only with `--figures`."""
        if self.figures is None:
            raise ValueError("no folder for figures was given")
        destination = self.figures / name
        if destination not in self._drawn:
            self._drawn.append(destination)
        return self.stage(destination)

    def stage(self, destination: Path) -> Path:
        """Path to write to now; `finish` moves the file to its destination."""
        if destination not in self._staged:
            kind = destination.suffix if len(destination.suffix) < 10 else ""  # suffixes may be very long
            self._staged[destination] = self._folder / f"{len(self._staged)}{kind}"
        return self._staged[destination]

    def finish(self, document: dict[str, Any]) -> None:
        """Write the staged files and the JSON document, with `format`, `version`, ... added."""
        envelope = {"format": f"hmmseg.{self.command}/1", "version": hmmseg.__version__, "seed": self.seed,
                    "warnings": self.warnings, "figures": [str(path) for path in self._drawn]}  # fmt: skip
        text = strict_json({**envelope, **document})
        if self.json not in (None, STANDARD_OUTPUT):
            self.stage(Path(self.json)).write_bytes(text.encode("utf-8", "backslashreplace"))
        _publish(self._staged)
        if self.json == STANDARD_OUTPUT:
            self.write(text)
        if self.lost:
            kept = ", ".join(str(path) for path in self._staged)
            raise InputError("standard output", f"cannot be written to ({self.lost})",
                             "somebody who reads" + (f"; written all the same: {kept}" if kept else "")
                             )  # fmt: skip


def strict_json(document: Any) -> str:
    """JSON text of dicts, sequences, numbers and arrays; NaN and infinities become null."""
    return jsonlib.dumps(_plain(document), indent=1, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):  # NumPy and JAX arrays and scalars
        return _plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return str(value) if isinstance(value, Path) else value


def distinct_trials(paths: Sequence[Path]) -> list[Path]:
    """The trials' paths, `FILE#NAME` for each recording of a file with several; InputError if one is given
    twice, as its noise would count as independent evidence."""
    seen: dict[str, Path] = {}
    out: list[Path] = []
    for given in paths:
        file, part = split_part(given)
        kind_of(file)
        parts, digest = [part] if part is not None else parts_of(given), str(file.resolve())
        if not file.is_dir():
            with named(str(file)), file.open("rb") as opened:
                digest = hashlib.file_digest(opened, "sha256").hexdigest()
        for name in parts or (None,):
            path = given if name is None or name == part else given.with_name(f"{given.name}#{name}")
            content = f"{digest}#{name or ''}"
            if content in seen:
                raise InputError(str(path), f"the same trial as {seen[content]}", "every trial once")
            seen[content] = path
            out.append(path)
    return out


TASK_KEYS = {"objects", "moves", "sequence"}  # a task has one of them
MAPS = {"columns", "topics"}  # keys of a rig that map columns, as `inspect --write` makes it
NO_HAND = MAPS | {"rate", "gravity"}  # keys that describe no hand


def find_inputs(trials: Sequence[Path], task: Path | None, rig: Path | None) -> tuple[Path, Path | None]:
    """Task and rig of these trials: as given, else task.toml and rig.toml in the folder of the first.
    InputError if there is no task, or if one is given as the other."""
    folder = split_part(trials[0])[0].parent
    found = [folder / name if given is None and (folder / name).is_file() else given
             for given, name in ((task, "task.toml"), (rig, "rig.toml"))]  # fmt: skip
    if found[0] is None:
        raise InputError("--task", "missing", f"the task's description, or a task.toml in {folder}")
    as_task, as_rig = (_keys(path) for path in found)
    if "sequence" in as_task and not (as_rig & MAPS and as_rig <= NO_HAND):
        found[1] = rig  # needs no hand, and a rig in its folder may be another task's
    if as_task and not as_task & TASK_KEYS and (task is not None or as_rig & TASK_KEYS):
        swapped = f"; are --task and --rig {found[1]} swapped?" if as_rig & TASK_KEYS else ""
        expected = f"objects and moves, or a sequence{swapped}"
        raise InputError(f"--task {found[0]}", "describes no task", expected)
    if as_rig & TASK_KEYS:
        raise InputError(f"--rig {found[1]}", "describes a task", "the description of a hand")
    return found[0], found[1]


def require_rig(rig: Path | None, trials: Sequence[Path]) -> Path:
    """The rig of a task of blocks; InputError if there is none."""
    if rig is None:
        expected = f"the nominal hand of a task of blocks, or a rig.toml in {split_part(trials[0])[0].parent}"
        raise InputError("--rig", "missing", expected)
    return rig


def refuse(problem: str, given: Mapping[str, Any]) -> None:
    """InputError for the first option given."""
    for option, value in given.items():
        if value:
            raise InputError(option, problem)


def _keys(path: Path | None) -> set[str]:
    """Top-level keys of a TOML file; none if it cannot be read, which its reader reports."""
    try:
        return set() if path is None else set(read_toml(path))
    except InputError:
        return set()


def read_trials(out: Output, paths: Sequence[Path], rig: Any = None, task: Any = None) -> list[Any]:
    """Read the trials of a command, with warnings about what is unlikely."""
    from hmmseg.hand.read import read_trial

    found = [read_trial(path, rig, task) for path in paths]
    if rig is not None and rig.effects and out.command != "simulate":
        names = ", ".join(rig.effects)
        out.warn(f"rig.toml's [effects] ({names}) act in simulate alone; they are left out here")
    for trial in found:
        out.warn(*trial.warnings)
        out.print(*trial.notes)
    return found


@contextlib.contextmanager
def named(where: str) -> Iterator[None]:
    """Turn refusals of the system (a name too long, a disk that is gone) into InputErrors."""
    try:
        yield
    except (OSError, ValueError) as error:
        raise InputError(where, str(getattr(error, "strerror", None) or error), "a file or folder") from None


def check_folder(option: str, folder: Path, shown: Path | None = None) -> None:
    """InputError, about the folder or what is `shown`, unless files can be written there; it may be new."""
    existing, where = folder.absolute(), f"{option} {shown or folder}"
    with named(where):
        while not existing.exists():
            existing = existing.parent
    if not existing.is_dir():
        raise InputError(f"{option} {folder}", f"{existing} is not a folder", "a folder")
    if not os.access(existing, os.W_OK | os.X_OK):
        raise InputError(where, f"{existing} cannot be written to", "a writable folder")


def check_file(option: str, path: Path, suffixes: Sequence[str] = (), refused: Sequence[str] = ()) -> None:
    """InputError unless this file can be written; `suffixes` are allowed, `refused` are not."""
    where = f"{option} {path}"
    with named(where), contextlib.suppress(FileNotFoundError, NotADirectoryError):
        path.lstat()
    if suffixes and path.suffix.lower() not in suffixes:
        raise InputError(where, "unknown kind of file", " or ".join(suffixes))
    if path.suffix.lower() in refused:  # `--json TRIAL.csv`, with its own argument forgotten
        raise InputError(where, "would be written over, and its name is that of an input", "a .json file")
    if path.is_dir():
        raise InputError(where, "is a folder", "a file")
    if not path.exists():
        check_folder(option, path.parent, shown=path)
    elif not os.access(path, os.W_OK):
        raise InputError(where, "cannot be written", "a writable file")


def _publish(staged: dict[Path, Path]) -> None:
    """Copy next to each destination first, then rename, so that no partial file is ever visible."""
    temporaries: dict[Path, Path] = {}
    destination = Path()
    try:
        for destination, source in staged.items():
            if destination.exists() and not destination.is_file():  # pipes and devices cannot be renamed onto
                destination.write_bytes(source.read_bytes())
                continue
            target = destination.resolve()
            target.parent.mkdir(parents=True, exist_ok=True)
            temporaries[target] = target.with_name(f".hmmseg-{os.getpid()}-{len(temporaries)}")
            shutil.copyfile(source, temporaries[target])
        _put(temporaries)
    except OSError as error:
        raise InputError(str(destination), f"cannot be written ({error.strerror})") from error
    finally:
        for temporary in temporaries.values():
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)


def _put(temporaries: dict[Path, Path]) -> None:
    """Rename all. If interrupted in between, the rest is renamed first; if refused, all is restored."""
    interrupted: KeyboardInterrupt | None = None
    before = {target: temporary.with_suffix(".old") for target, temporary in temporaries.items()}
    try:
        for target, old in before.items():
            if len(temporaries) > 1 and target.exists():
                shutil.copyfile(target, old)
        for target, temporary in temporaries.items():
            try:
                os.replace(temporary, target)
            except KeyboardInterrupt as interrupt:
                interrupted = interrupt
                if temporary.exists():
                    os.replace(temporary, target)
    except OSError:
        for target, temporary in temporaries.items():
            if before[target].exists():
                os.replace(before[target], target)
            elif not temporary.exists():
                target.unlink(missing_ok=True)
        raise
    finally:
        for old in before.values():
            with contextlib.suppress(OSError):
                old.unlink(missing_ok=True)
    if interrupted is not None:
        raise interrupted


@contextlib.contextmanager
def scratch() -> Iterator[Path]:
    """A folder for temporary files of this run."""
    try:
        folder = tempfile.TemporaryDirectory(prefix="hmmseg_", ignore_cleanup_errors=True)
    except OSError as error:
        raise InputError("the folder for temporary files", f"cannot be used ({error.strerror})",
                         "TMPDIR to name one that can be written to") from None  # fmt: skip
    with folder as name:
        yield Path(name)


class _Screen(Console):
    """A console that escapes control characters, and that may lose its reader."""

    lost: str = ""  # why nothing can be written any more

    def on_broken_pipe(self) -> None:  # rich itself would end the process
        raise BrokenPipeError(errno.EPIPE, os.strerror(errno.EPIPE))

    def render(self, renderable: Any, options: Any = None) -> Iterator[Segment]:
        for segment in super().render(renderable, options):
            if segment.control:
                yield segment
            else:
                yield Segment(escape_control(segment.text), segment.style)

    @contextlib.contextmanager
    def unless_lost(self, stream: Any = None) -> Iterator[None]:
        """After a reader is gone, or a disk is full, write nothing more to it; `stream`: if not the own."""
        try:
            yield
        except OSError as error:
            self.lost = self.lost or error.strerror or "it is closed"
            self.quiet = True
            discard(stream or self.file)


def discard(stream: Any) -> None:
    """Drop what is left in a stream's buffer, about which Python would complain at exit."""
    with contextlib.suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


CONTROL = {code: f"\\x{code:02x}" for code in (*range(9), *range(11, 32), *range(127, 160))}


def escape_control(text: str) -> str:
    """The text with control characters as \\x1b: file names may contain any."""
    return text.translate(CONTROL)


def _console(file: Any, quiet: bool) -> _Screen:
    width = None if file.isatty() or "COLUMNS" in os.environ else 120  # rich would wrap pipes at 80
    return _Screen(file=file, quiet=quiet, width=width)
