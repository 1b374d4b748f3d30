"""Tables of docs/benchmarks.md and docs/watch.md."""

from __future__ import annotations

from experiments.table_text import load, markdown, percent


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
