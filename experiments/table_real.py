"""README: recordings of real robots and people, from the experiments of experiments/real."""

from __future__ import annotations

from experiments.table_text import load, markdown

KINDS = {"real_guarded": "guarded", "real_pivot": "pivoting"}
CHANNELS = {"wrench_and_pose": "force, torque and pose", "wrench": "force and torque alone"}


def real() -> str | None:
    """Both tables; a result that is not there is left out."""
    parts = [part for part in (snap(), handover()) if part is not None]
    return "\n\n".join(parts) if parts else None


def snap() -> str | None:
    """A robot's snap assembly: errors at both contact boundaries, by what was learned from."""
    found = load("hiro_snap")
    if found is None:
        return None
    rows = []
    for kind, label in KINDS.items():
        entry = found["kinds"][kind]
        rows.append([label, "none: answers the training mean", *_mean(entry["training_mean"])])
        rows.append([label, "the same, recordings not cropped", *_mean(entry["training_mean_uncropped"])])
        for channels, heard in CHANNELS.items():
            for method, taught in (
                ("with_labels", "labels of the other half"),
                ("without_labels", "no labels"),
            ):
                s = entry[channels][method]
                cells = [_cell(s, b) for b in (0, 1)]
                rows.append([label, f"{heard}; {taught}", *cells])
    head = ["trials", "learned from", "approach to rotation", "insertion to mating"]
    trials = ", ".join(f"{found['kinds'][k]['wrench']['with_labels']['trials'] // found['seeds']} {label}"
                       for k, label in KINDS.items())  # fmt: skip
    note = (
        f"Snap assembly by a HIRO robot (200 Hz; {trials} trials, {found['seeds']} random crops of up to "
        f"{found['max_crop']:g} s each): median error against the controller's labels, 95th percentile, "
        "share within 0.3 s. To reach: a median of 60 ms with labels, all within 0.3 s without."
    )
    return f"{note}\n\n{markdown(head, rows)}"


def _mean(medians: list[float]) -> list[str]:
    return [f"{1e3 * value:.0f} ms" for value in medians]


def _cell(s: dict, b: int) -> str:
    median, late = 1e3 * s["median_abs"][b], 1e3 * s["p95_abs"][b]
    return f"{median:.0f} ms, {late:.0f} ms, {100 * s['within_0.3'][b]:.0f} %"


def handover() -> str | None:
    """People hand over a baton: lift-off and putting-down from forces against the baton's height."""
    found = load("kth_handover")
    if found is None:
        return None
    rows = []
    for row in found["recordings"]:
        apart = [row[e]["force"] - row[e]["height"] for e in ("lift_off", "put_down")]
        rows.append([row["recording"], *(f"{1e3 * value:+.0f} ms" for value in apart)])
    note = (
        "Handovers of a baton between people (120 Hz, no labels at all): when forces alone say that it was "
        "lifted and put down, less when its height leaves and reaches "
        f"{1e3 * found['clearance']:g} mm above its rest. To reach: 200 ms."
    )
    return f"{note}\n\n{markdown(['recording', 'lift-off', 'putting-down'], rows)}"
