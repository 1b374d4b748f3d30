"""Tables of docs/benchmarks.md and docs/watch.md."""

from __future__ import annotations

from experiments.table_text import load, markdown, percent

ORDER = ("hmmseg, float64, as called", "hmmseg, float32, as called", "hmmseg, JAX inside jit",
         "hmmlearn's kernel", "dynamax")  # fmt: skip
CASES = {"one trial": "one trial, 200 x 9", "4,096 trials": "4,096 trials of 150 to 200 x 9",
         "one stream": "one stream, 1,000,000 x 9", "many states": "one stream, 100,000 x 101"}  # fmt: skip


def kernels() -> str | None:
    """docs/benchmarks.md: Viterbi paths as ratios to the limit."""
    found = load("benchmark_kernels")
    if found is None:
        return None
    rows = []
    for key, title in CASES.items():
        case = found[key]
        cells = [f"{case['viterbi'][name]['ratio']:.2f}" if name in case["viterbi"] else "" for name in ORDER]
        rows.append([title, f"{1e3 * case['limit']:.3f} ms", *cells])
    versions = ", ".join(f"{k} {v or 'not to be had'}" for k, v in found["versions"].items())
    moved = found["exactness"]
    agree = all(row.get("same_path", True) for key in CASES for row in found[key]["viterbi"].values())
    told = (
        f"Versions: {versions}. Repeats: {found['repeats']}. All paths "
        f"{'are the same' if agree else 'are NOT the same'}. Labels that single precision moves in "
        f"{moved['samples']:,} samples of states half a standard deviation apart: {moved['moved']}."
    )
    return markdown(["case", "limit", *ORDER], rows) + "\n\n" + told


def smoothing() -> str | None:
    """docs/benchmarks.md: forward-backward with boundary posteriors."""
    found = load("benchmark_kernels")
    if found is None:
        return None
    rows = []
    for key in ("one trial", "one stream", "many states"):
        case, times = found[key], found[key]["smoothing"]
        other = times.get("hmmlearn's kernels")
        rows.append([CASES[key], f"{1e3 * times['hmmseg']:.3f} ms", f"{case['smoothing_over_viterbi']:.1f}",
                     "" if other is None else f"{other / times['hmmseg']:.1f}"])  # fmt: skip
    head = ["case", "`smooth`", "over its own `viterbi`", "hmmlearn's forward and backward over it"]
    return markdown(head, rows)


def commands() -> str | None:
    """docs/benchmarks.md: commands on one 10 s trial, by stage."""
    found = load("benchmark_commands")
    if found is None:
        return None
    rows = [
        [name, f"{1e3 * s['processor']:.0f} ms", percent(s["share"], 0)]
        for name, s in found["stages"].items()
    ]
    told = "; ".join(f"`hmmseg {name}` {v['warm']:.1f} s warm" for name, v in found["commands"].items())
    return (
        markdown(["stage of `segment`", "processor", "share"], rows)
        + f"\n\nWhole commands, processor: {told}."
    )


def lengths() -> str | None:
    """docs/benchmarks.md: long recordings."""
    found = load("benchmark_long")
    if found is None:
        return None
    rows = [
        [f"{row['seconds']:.0f} s", f"{row['rows']:,}", f"{row['found']} of {row['rounds']}",
         f"{row['processor']:.2f} s", f"{1e6 * row['processor'] / row['rows']:.1f} µs",
         f"{row['memory_mb']:.0f} MB"]
        for row in found["lengths"]
    ]  # fmt: skip
    head = ["recording", "rows", "rounds found", "processor", "a row", "memory on top"]
    return markdown(head, rows)


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
