"""The seal: a salted hash of the labels, published before anything is diagnosed."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
JUDGED = ("hmmseg", "estimation", "simgap")


class BrokenSeal(ValueError):
    """The labels differ from those that were sealed."""


def digest(labels: dict[str, Any], salt: str) -> str:
    """SHA-256 of salt and labels in one fixed spelling."""
    text = json.dumps(labels, sort_keys=True, separators=(",", ":"))
    return hashlib.sha256(f"{salt}\n{text}".encode()).hexdigest()


def seal(folder: Path, labels: dict[str, Any], salt: str) -> str:
    """Write sealed/labels.json and sealed/salt, and seal.json with the hash alone; the hash."""
    found = digest(labels, salt)
    (folder / "sealed").mkdir(parents=True, exist_ok=True)
    (folder / "sealed" / "labels.json").write_text(json.dumps(labels) + "\n", encoding="utf-8")
    (folder / "sealed" / "salt").write_text(salt + "\n", encoding="utf-8")
    table = {"sha256": found, "of": "salt, newline, labels.json with sorted keys and no spaces",
             "cases": len(labels["cases"]), "status": "sealed"}  # fmt: skip
    (folder / "seal.json").write_text(json.dumps(table, indent=1) + "\n", encoding="utf-8")
    return found


def unseal(folder: Path) -> dict[str, Any]:
    """The labels; BrokenSeal if they do not match the published hash."""
    labels = json.loads((folder / "sealed" / "labels.json").read_text(encoding="utf-8"))
    salt = (folder / "sealed" / "salt").read_text(encoding="utf-8").strip()
    stated = json.loads((folder / "seal.json").read_text(encoding="utf-8"))["sha256"]
    if digest(labels, salt) != stated:
        raise BrokenSeal(f"{folder}: the labels do not have the published hash {stated}")
    return labels


def code_digest() -> str:
    """SHA-256 of the code that is judged: every Python file and bank of the packages in JUDGED."""
    found = hashlib.sha256()
    for package in JUDGED:
        for file in sorted((ROOT / package).rglob("*")):
            if file.suffix in (".py", ".json"):
                found.update(file.relative_to(ROOT).as_posix().encode() + b"\0" + file.read_bytes())
    return found.hexdigest()
