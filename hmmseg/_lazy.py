"""Packages whose public names are imported on first use, so that importing the packages is quick.

The package's stub, which type checkers and editors read, is the only list of public names and their modules.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def lazily(package: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """`__getattr__`, `__dir__` and `__all__` of a package, from the imports of the stub next to its
    `file`."""
    stub = ast.parse(Path(file).with_suffix(".pyi").read_text(encoding="utf-8"))
    imports = [node for node in stub.body if isinstance(node, ast.ImportFrom)]
    homes = {alias.name: node.module or "" for node in imports for alias in node.names}
    public: list[str] = sorted(homes.keys() | ({"__version__"} & vars(sys.modules[package]).keys()))

    def attribute(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        inside = homes[name] == package  # a module of the package itself
        module = importlib.import_module(f"{package}.{name}" if inside else homes[name])
        value = module if inside else getattr(module, name)
        setattr(sys.modules[package], name, value)  # found without `__getattr__` from now on
        return value

    def names() -> list[str]:
        return sorted({*public, *(name for name in vars(sys.modules[package]) if name.startswith("__"))})

    return attribute, names, public
