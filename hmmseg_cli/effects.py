"""`hmmseg effects`: the candidate effects of a sim-to-real gap."""

from __future__ import annotations

from typing import Any

from rich.table import Table

from hmmseg_cli.console import JsonOption, Output, QuietOption, UnusedSeed


def effects(json: JsonOption = None, seed: UnusedSeed = 0, quiet: QuietOption = False) -> None:
    """The candidate effects, their parameters, priors and signatures."""
    with Output("effects", json=json, seed=seed, quiet=quiet) as out:
        from simgap.effects import catalogue

        rows = [description(effect) for effect in catalogue().values()]
        out.print(table(rows))
        out.finish({"effects": rows})


def description(effect) -> dict[str, Any]:
    """An effect as JSON: priors are normal in the parameter, or in its logarithm."""
    parameters = [
        {
            "name": p.name,
            "unit": p.unit,
            "starts": list(p.starts) or [p.nominal],
            "prior": {
                "kind": "log-normal" if p.log else "normal",
                "centre": p.nominal,
                "sd": p.sd,
                "low": p.low,
                "high": p.high,
            },
        }
        for p in effect.parameters.values()
        if not p.hidden
    ]
    return {
        "name": effect.name,
        "acts_on": effect.acts_on,
        "says": effect.says,
        "signature": effect.shows,
        "mistaken_for": list(effect.mistaken_for),
        "chosen": effect.chosen,
        "parameters": parameters,
    }


def table(rows: list[dict[str, Any]]) -> Table:
    """The effects for people to read."""
    out = Table(title="candidate effects", title_justify="left", show_lines=False)
    for head in ("effect", "acts on", "says", "shows in", "parameters (prior sd)"):
        out.add_column(head, no_wrap=head == "effect")
    for row in rows:
        shown = ", ".join(
            f"{p['name']} ({p['prior']['sd']:g} {p['unit'] if p['prior']['kind'] == 'normal' else 'in ln'})"
            for p in row["parameters"]
        )
        out.add_row(row["name"], row["acts_on"], row["says"], row["signature"], shown)
    return out
