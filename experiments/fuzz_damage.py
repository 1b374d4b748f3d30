"""Ways to damage a file: cut, lines shuffled or doubled, bytes flipped, cells beyond reason, unknown keys."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

CELLS = ("nan", "inf", "-inf", "1e400", "-1e308", "1e-320", "", " ", "abc", "1,5", "0x10", "1_000", "1e",
         "--1", "٣", "9" * 5000, "\x00", '"', "'", "=1+1", "1970-01-01T00:00:00", "True", "null")  # fmt: skip
TOKENS = ("[", "]", "{", "}", "=", '"', "'''", "\n", "\x00", "\ufeff", "#", "inf", "nan", "1e999", "9" * 400,
          "[[a]]", "a.b.c = 1", "[" * 2000, "{a=" * 500, "-1", "true", '""', "2020-01-01",
          "\\u0000", "\ud7ff")  # fmt: skip
VALUES = ("-1", "0", "nan", "inf", "1e308", '"x"', "[]", "[1]", "{}", "true", "[" + "1," * 40 + "]",
          "1979-05-27", "9" * 300)  # fmt: skip
Damage = Callable[[bytes, np.random.Generator], bytes]


def cut(data: bytes, rng: np.random.Generator) -> bytes:
    """The beginning of a file."""
    return data[: int(rng.integers(0, len(data) + 1))]


def flipped(data: bytes, rng: np.random.Generator) -> bytes:
    """Some bytes replaced."""
    out = np.frombuffer(data, np.uint8).copy()
    if out.size:
        at = rng.integers(0, out.size, int(rng.integers(1, 9)))
        out[at] = rng.integers(0, 256, at.size)
    return out.tobytes()


def shuffled(data: bytes, rng: np.random.Generator) -> bytes:
    """Lines in another order, the first sometimes left."""
    lines = data.split(b"\n")
    keep = int(rng.integers(0, 2))
    return b"\n".join([*lines[:keep], *(lines[keep:][i] for i in rng.permutation(len(lines) - keep))])


def doubled(data: bytes, rng: np.random.Generator) -> bytes:
    """A stretch twice."""
    a, b = sorted(int(i) for i in rng.integers(0, len(data) + 1, 2))
    return data[:b] + data[a:b] + data[b:]


def celled(data: bytes, rng: np.random.Generator) -> bytes:
    """A few cells of a table replaced."""
    lines = data.split(b"\n")
    for _ in range(int(rng.integers(1, 4))):
        row = int(rng.integers(0, min(len(lines), 12)))
        cells = lines[row].split(b",")
        cells[int(rng.integers(0, len(cells)))] = str(rng.choice(CELLS)).encode("utf-8", "surrogatepass")
        lines[row] = b",".join(cells)
    return b"\n".join(lines)


def columned(data: bytes, rng: np.random.Generator) -> bytes:
    """A column gone, all alike, or twice."""
    rows = [line.split(b",") for line in data.split(b"\n")]
    at, kind = int(rng.integers(0, len(rows[0]))), int(rng.integers(0, 3))
    for row in rows:
        if at < len(row):
            if kind == 0:
                del row[at]
            elif kind == 1:
                row[at] = rows[0][at] if row is rows[0] else b"3"
            else:
                row.append(row[at])
    return b"\n".join(b",".join(row) for row in rows)


def tokened(data: bytes, rng: np.random.Generator) -> bytes:
    """Tokens of TOML and JSON put in anywhere."""
    text = data.decode("utf-8", "replace")
    for _ in range(int(rng.integers(1, 4))):
        at = int(rng.integers(0, len(text) + 1))
        text = text[:at] + str(rng.choice(TOKENS)) + text[at:]
    return text.encode("utf-8", "surrogatepass")


def valued(data: bytes, rng: np.random.Generator) -> bytes:
    """The value of a key replaced."""
    lines = data.split(b"\n")
    keys = [i for i, line in enumerate(lines) if b"=" in line]
    if keys:
        i = int(rng.choice(keys))
        lines[i] = lines[i].split(b"=")[0] + b"= " + str(rng.choice(VALUES)).encode()
    return b"\n".join(lines)


TABLES: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, celled, celled, celled, columned)
TEXTS: tuple[Damage, ...] = (cut, flipped, shuffled, doubled, tokened, tokened, valued, valued)
BINARIES: tuple[Damage, ...] = (cut, flipped, flipped, doubled)
