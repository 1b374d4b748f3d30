"""Tables of docs/benchmarks.md and docs/watch.md."""

from __future__ import annotations

from experiments.table_text import load, markdown, percent

OTHERS = ("hmmlearn's kernel", "dynamax")


def alignment() -> str | None:
    """README.md, docs/benchmarks.md: paths and posteriors by hmmseg.hmm and by other libraries."""
    found = load("benchmark_hmm")
    if found is None:
        return None
    rows = []
    for title, case in found["cases"].items():
        times = case["seconds"]
        own = times["inside jit"]
        others = [f"{times[n] / own:.1f} x" if n in times else "" for n in ("as called", *OTHERS)]
        rows.append([title, f"{1e3 * own:.3g} ms", *others])
    versions = ", ".join(f"{name} {version}" for name, version in found["versions"].items())
    same = "the same" if all(case["same"] for case in found["cases"].values()) else "NOT the same"
    table = markdown(["", "`hmmseg.hmm` inside jit", "as called", *OTHERS], rows)
    return f"{table}\n\nAll paths are {same}. Versions: {versions}."


def accelerator() -> str | None:
    """docs/benchmarks.md: the same recursions in parallel on an accelerator."""
    found = load("benchmark_hmm_parallel")
    if found is None:
        return None
    peers = ("row by row, processor", "torchaudio.forced_align", "torbi")
    rows = []
    for title, case in found["cases"].items():
        times = case["seconds"]
        own = times["associative scan"]
        others = [f"{times[n] / own:.0f} x" if times.get(n) else "" for n in peers]
        rows.append([title, f"{1e3 * own:.2g} ms", *others])
    table = markdown(["", "`hmmseg.hmm`, associative scan", *peers], rows)
    cases = found["cases"].values()
    same = {n: min(c["same"].get(n, 1.0) for c in cases) for n in ("associative scan", *peers[1:])}
    shares = ", ".join(f"{n} {percent(share, 2)}" for n, share in same.items())
    far = max(max(c["largest difference"].values(), default=0.0) for c in cases)
    return (
        f"{table}\n\nWall time on one {found['device']}, JAX {found['jax']}. Trials with all starts as "
        f"found row by row, least of all cases (torchaudio and torbi in single precision): {shares}. "
        f"Posteriors differ by {far:.0e} at most."
    )


def samplers() -> str | None:
    """docs/benchmarks.md: effective samples a second on the same log density."""
    found = load("reference_posteriors")
    if found is None:
        return None
    rows = []
    for task in found["tasks"]:
        own, nuts, plain = (task[f"{kind}ess_per_second"] for kind in ("", "nuts_", "stretch_"))
        rows.append([f"{task['blocks']} x {task['trials']}", f"{own:,.0f}", f"{nuts:,.0f}", f"{plain:,.0f}",
                     f"{own / max(nuts, plain):.1f}"])  # fmt: skip
    head = ["blocks x trials", "`identify`", "NumPyro's NUTS", "emcee as it comes", "ahead of the better by"]
    return markdown(head, rows)


def commands() -> str | None:
    """docs/benchmarks.md: commands on one 10 s trial, by stage."""
    found = load("benchmark_commands")
    if found is None:
        return None
    tables = [
        markdown(
            [f"stage of `{command}`", "processor", "share"],
            [[name, f"{1e3 * s['processor']:.0f} ms", percent(s["share"], 0)] for name, s in stages.items()],
        )
        for command, stages in found["stages"].items()
    ]
    told = "; ".join(
        f"`hmmseg {name}` {v['warm']:.1f} s warm, {v['first']:.0f} s the first time ever"
        for name, v in found["commands"].items()
    )
    return "\n\n".join([*tables, f"Whole commands, processor: {told}."])


def batch() -> str | None:
    """docs/benchmarks.md: many trials, each by itself."""
    found = load("benchmark_batch")
    if found is None:
        return None
    rows = [
        [f"{found['trials']:,}", f"{run['workers']}", f"{run['wall']:.0f} s", f"{run['processor']:.0f} s",
         f"{1e3 * run['processor'] / found['trials']:.0f} ms"]
        for run in found["runs"]
    ]  # fmt: skip
    told = (
        f"{found['complete']:,} fit their task. Load of the {found['cores']} cores beside it: "
        f"{found['load']:.0f}. Digits from 1, 2 and 3 workers ({found['compared']} trials): "
        f"{'the same' if found['same_digits'] else 'NOT the same'}."
    )
    return markdown(["trials", "workers", "time", "processor", "a trial"], rows) + f"\n\n{told}"


def haptic() -> str | None:
    """docs/virtual_model.md: the haptic loop beside one that does nothing."""
    found = load("haptic_loop")
    if found is None:
        return None
    rate = found["rate"]
    rows = [
        ["two blocks", f"{rate['median_us']:.0f} µs", f"{rate['p99_9_us']:.0f} µs",
         f"{rate['worst_us'] / 1e3:.2f} ms", f"{rate['late']} of {rate['steps']:,}"],
        ["as long, spinning", "", f"{rate['spinning_loop_p99_9_us']:.0f} µs",
         f"{rate['spinning_loop_worst_us'] / 1e3:.2f} ms", f"{rate['spinning_loop_late']}"],
        ["empty", "", "", f"{rate['empty_loop_worst_us'] / 1e3:.2f} ms", f"{rate['empty_loop_late']}"],
    ]  # fmt: skip
    told = (
        f"Programs compiled in the loop: {rate['programs_compiled_in_the_loop']}; bytes grown in 10,000 "
        f"steps: {rate['grown_bytes_in_10000_steps']} (the interpreter's own)."
    )
    return markdown(["loop", "median", "99.9 %", "worst", "late"], rows) + f"\n\n{told}"


def watch() -> str | None:
    """docs/watch.md: what `make bench-watch` measured."""
    found = load("watch")
    if found is None:
        return None
    time, lag, apart = found["timing"], found["by_lag"], found["apart_from_off_line"]
    rows = [
        [f"{time['rows']:,} rows at {time['rate']:.0f} Hz, processor a row, median",
         f"{time['median_us']:.0f} µs"],
        ["... 99.9 % of rows within", f"{time['q999_us']:.0f} µs"],
        ["... rows within 1 ms", percent(time["within_1ms"], 2)],
        ["... growth of memory over the last eight minutes",
         f"{time['memory_mb'][-1] - time['memory_mb'][1]:.0f} MB"],
        ["error of a boundary at a lag of 1 s, median and 90 %",
         f"{lag['1.0']['median_ms']:.1f} and {lag['1.0']['q90_ms']:.1f} ms"],
        ["... of the whole recording off line",
         f"{lag['off line']['median_ms']:.1f} and {lag['off line']['q90_ms']:.1f} ms"],
        ["boundaries within two standard deviations of the truth (off line)",
         f"{percent(lag['1.0']['within_2_sd'], 0)} ({percent(lag['off line']['within_2_sd'], 0)})"],
        ["... and of those off line, of both", percent(apart["within_2_sd"], 0)],
        ["weights within two standard deviations of the truth",
         f"{percent(found['weight_within_2_sd'], 0)} of {found['weights']}"],
        ["last verdict (fits or not) as off line",
         f"{found['same_verdict']} of {found['recordings']} recordings"],
        ["fitting recordings with a passing false alarm", f"{len(found['alarms_on_fitting'])}"],
    ]  # fmt: skip
    return markdown(["", "measured"], rows)
