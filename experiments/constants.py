"""Write every numeric constant with its kind and reason, from its comment, to docs/tables/constants.csv.

    python -m experiments.constants

A constant is a number, or a tuple or dict of numbers, given to a name in capitals at the top of a module.
Its kind is the first word of its comment (CONTRIBUTING.md): physics, numerics, cited, learned, prior, limit,
look or chosen. A test wants a kind and a reason of each.
"""

from __future__ import annotations

import ast
import csv
import io
import re
import tokenize
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
PACKAGES = ("hmmseg", "estimation", "simgap", "hmmseg_cli")
KINDS = {
    "physics": "a constant of nature, or a definition",
    "numerics": "changes cost or accuracy of a computation, no result beyond that",
    "cited": "from the literature or a data sheet",
    "learned": "by a script, on data that it names",
    "prior": "believed before a recording is seen, or the shape of its noise: a likelihood may overrule it",
    "limit": "what input is taken at all; beyond it a line says so",
    "look": "of pictures, tables, pages and the hand that plays: no answer depends on it",
    "chosen": "by judgement: it decides between answers",
    "unstated": "its comment does not say",
}
NAME = re.compile(r"^_?[A-Z][A-Z0-9_]*$")
STATED = re.compile(r"^(physics|numerics|cited|learned|prior|limit|look|chosen)\b[:;,]?\s*(.*)$", re.DOTALL)


@dataclass(frozen=True)
class Constant:
    """One constant: file, line, name, value as written, kind and reason."""

    file: str
    line: int
    name: str
    value: str
    kind: str
    reason: str


def comments(source: str) -> dict[int, str]:
    """Comments by line, without the hash."""
    found = {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            found[token.start[0]] = token.string.lstrip("# ").strip()
    return found


def numeric(node: ast.expr) -> bool:
    """Whether an expression is made of numbers alone."""
    if isinstance(node, ast.Constant):
        return isinstance(node.value, int | float) and not isinstance(node.value, bool)
    if isinstance(node, ast.UnaryOp):
        return numeric(node.operand)
    if isinstance(node, ast.BinOp):
        return numeric(node.left) and numeric(node.right)
    if isinstance(node, ast.Tuple | ast.List):
        return bool(node.elts) and all(numeric(each) for each in node.elts)
    if isinstance(node, ast.Dict):
        return bool(node.values) and all(numeric(each) for each in node.values)
    if isinstance(node, ast.Call):  # np.array([...]), np.log(2); range(3) numbers names
        named = isinstance(node.func, ast.Name) and node.func.id == "range"
        return (
            not named and bool(node.args) and all(numeric(each) for each in node.args) and not node.keywords
        )
    return False


def constants(path: Path) -> Iterator[Constant]:
    """Constants at the top of one module, in its order.

    The comment is the one that ends the line (or lines) of the value, with what goes on below it in lines of
    comment that begin with a small letter, else the lines of comment right above.
    """
    source = path.read_text(encoding="utf-8")
    said, file = comments(source), str(path.relative_to(ROOT))
    lines = source.splitlines()
    for node in ast.parse(source).body:
        target = node.targets[0] if isinstance(node, ast.Assign) else getattr(node, "target", None)
        value = getattr(node, "value", None)
        if not isinstance(node, ast.Assign | ast.AnnAssign) or value is None or target is None:
            continue
        names = target.elts if isinstance(target, ast.Tuple) else [target]
        texts = [each.id for each in names if isinstance(each, ast.Name) and NAME.match(each.id)]
        if not texts or not numeric(value):
            continue
        last = node.end_lineno or node.lineno
        kind, reason = stated(said, lines, node.lineno, last)
        shown = " ".join(ast.get_source_segment(source, value).split())  # type: ignore[union-attr]
        yield Constant(file, node.lineno, ", ".join(texts), shown, kind, reason)


def goes_on(text: str) -> bool:
    """Whether a comment continues the one above it, rather than describing the constant below."""
    return text[:1].islower() and STATED.match(text) is None


def stated(said: dict[int, str], lines: list[str], first: int, last: int) -> tuple[str, str]:
    """Kind and reason of a constant on lines `first` to `last`."""
    words = [said[k] for k in range(first, last + 1) if k in said]
    after = last + 1
    while words and goes_on(said.get(after, "-")) and lines[after - 1].lstrip().startswith("#"):
        words.append(said[after])
        after += 1
    before = first - 1
    above: list[str] = []
    while before in said and lines[before - 1].startswith("#"):
        above.insert(0, said[before])
        before -= 1
    for text in (" ".join(words), " ".join(above)):
        found = STATED.match(text)
        if found:
            return found[1], found[2]
    return "unstated", " ".join(words or above)


def every() -> list[Constant]:
    """Constants of the whole product."""
    paths = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return [constant for path in paths for constant in constants(path)]


def main() -> None:
    found = sorted(every(), key=lambda c: list(KINDS).index(c.kind))
    with (ROOT / "docs/tables/constants.csv").open("w", encoding="utf-8", newline="") as file:
        write = csv.writer(file, lineterminator="\n")
        write.writerow(["kind", "constant", "value", "file", "reason"])
        write.writerows([c.kind, c.name, c.value, c.file, c.reason] for c in found)
    print(", ".join(f"{n} {kind}" for kind, n in Counter(c.kind for c in found).most_common()))


if __name__ == "__main__":
    main()
