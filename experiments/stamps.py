"""The commit that made a figure, inside the figure: a text of a PNG, a comment of a GIF.

    python -m experiments.stamps

Figures in docs/figures that were drawn since the last commit and came out otherwise get this code's commit.
"""

from __future__ import annotations

import re
import struct
import subprocess
import zlib
from pathlib import Path

from matplotlib.figure import Figure

from experiments.saving import ROOT, commit_of

FIGURES = ROOT / "docs" / "figures"
KEY = b"made_by\0"
SIGNATURE = b"\x89PNG\r\n\x1a\n"
COMMENT = re.compile(rb"!\xfe.made_by\0([0-9a-f+]+)\0;$", re.DOTALL)  # the last of a GIF


def chunks(png: bytes) -> list[tuple[bytes, bytes]]:
    """Kinds and contents of a PNG's chunks, in order."""
    found, at = [], len(SIGNATURE)
    while at < len(png):
        (size,) = struct.unpack(">I", png[at : at + 4])
        found.append((png[at + 4 : at + 8], png[at + 8 : at + 8 + size]))
        at += 12 + size
    return found


def bare(data: bytes) -> bytes:
    """The picture without a stamp; ValueError if it is neither PNG nor GIF."""
    if data.startswith(SIGNATURE):
        return _png(
            [chunk for chunk in chunks(data) if not (chunk[0] == b"tEXt" and chunk[1].startswith(KEY))]
        )
    if data.startswith(b"GIF8"):
        return COMMENT.sub(b";", data)
    raise ValueError("a picture that is neither PNG nor GIF")


def stamped(data: bytes, commit: str) -> bytes:
    """The picture with this commit in place of any other."""
    plain, text = bare(data), KEY + commit.encode("ascii")
    if plain.startswith(SIGNATURE):
        *others, end = chunks(plain)
        return _png([*others, (b"tEXt", text), end])
    return plain[:-1] + b"!\xfe" + bytes([len(text)]) + text + b"\0;"


def _png(found: list[tuple[bytes, bytes]]) -> bytes:
    return SIGNATURE + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
        for kind, body in found
    )


def stamp_of(data: bytes) -> str | None:
    """The commit that a picture names, None without one."""
    if data.startswith(SIGNATURE):
        texts = [body for kind, body in chunks(data) if kind == b"tEXt" and body.startswith(KEY)]
        return texts[0].removeprefix(KEY).decode("ascii") if texts else None
    found = COMMENT.search(data)
    return found[1].decode("ascii") if found else None


def stamp(path: Path) -> None:
    """Stamp a figure with this code's commit; one that came out as it was committed keeps its stamp."""
    commit, data, before = commit_of(), path.read_bytes(), _committed(path)
    if commit is None or (data == before and stamp_of(data) is not None):
        return
    if before is not None and stamp_of(before) is not None and bare(before) == bare(data):
        path.write_bytes(before)
    else:
        path.write_bytes(stamped(data, commit))


def save_figure(figure: Figure, path: Path) -> None:
    """Save a figure of a page, stamped."""
    figure.savefig(path, dpi=110)
    stamp(path)


def main() -> None:
    """Stamp what was drawn."""
    for path in sorted(FIGURES.iterdir()):
        stamp(path)


def _committed(path: Path) -> bytes | None:
    """The figure as it was last committed; None of a new one."""
    if not path.is_relative_to(ROOT):
        return None
    command = ["git", "-C", str(ROOT), "show", f"HEAD:{path.relative_to(ROOT)}"]
    done = subprocess.run(command, capture_output=True)
    return done.stdout if done.returncode == 0 else None


if __name__ == "__main__":
    main()
