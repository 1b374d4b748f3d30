"""The commit that made a figure, inside the figure: a text of a PNG, a comment of a GIF.

    python -m experiments.stamps

Figures in docs/figures that were drawn since the last commit, or say nothing yet, get this code's commit.
"""

from __future__ import annotations

import re
import struct
import subprocess
import zlib
from pathlib import Path

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


def stamped(data: bytes, commit: str) -> bytes:
    """The picture with this commit in place of any other; ValueError if it is neither PNG nor GIF."""
    text = KEY + commit.encode("ascii")
    if data.startswith(SIGNATURE):
        kept = [chunk for chunk in chunks(data) if not (chunk[0] == b"tEXt" and chunk[1].startswith(KEY))]
        kept.insert(len(kept) - 1, (b"tEXt", text))  # before the last, which ends the picture
        return SIGNATURE + b"".join(
            struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
            for kind, body in kept
        )
    if data.startswith(b"GIF8"):
        return COMMENT.sub(b";", data)[:-1] + b"!\xfe" + bytes([len(text)]) + text + b"\0;"
    raise ValueError("a picture that is neither PNG nor GIF")


def stamp_of(data: bytes) -> str | None:
    """The commit that a picture names, None without one."""
    if data.startswith(SIGNATURE):
        texts = [body for kind, body in chunks(data) if kind == b"tEXt" and body.startswith(KEY)]
        return texts[0].removeprefix(KEY).decode("ascii") if texts else None
    found = COMMENT.search(data)
    return found[1].decode("ascii") if found else None


def main() -> None:
    """Stamp what was drawn."""
    commit = commit_of()
    if commit is None:
        return
    said = subprocess.run(["git", "-C", str(ROOT), "status", "--porcelain", "docs/figures"],
                          check=True, capture_output=True, text=True).stdout  # fmt: skip
    drawn = {Path(line[3:]).name for line in said.splitlines()}
    for path in sorted(FIGURES.iterdir()):
        data = path.read_bytes()
        if path.name in drawn or stamp_of(data) is None:
            path.write_bytes(stamped(data, commit))
            print(f"{path.name}: {commit}")


if __name__ == "__main__":
    main()
