"""A diagnosis in words and tables, from its JSON: the verdict, how sure it is, what remains, what to do."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hmmseg.levels import CERTAIN
from hmmseg.numbers import between, estimate, interval, percent, plain, shown_as
from hmmseg.tables import listed

if TYPE_CHECKING:
    from rich.table import Table

    from simgap.effects.base import HandEffect


def plain_name(
    effect: str, means: Mapping[str, float] | None = None, rig: Mapping[str, Any] | None = None
) -> str:
    """Effects joined by +, in plain words; `means` are their parameters, `rig` the model's pads."""
    texts, names = [], effect.split("+")
    for name in names:
        called, _, known = _words(name)
        if means and known is not None and known.phrase is not None:
            own = {k: v for k, v in means.items() if len(names) == 1 or k.startswith(f"{name}.")}
            called = known.phrase({k.removeprefix(f"{name}."): v for k, v in own.items()}, rig or {})
        texts.append(called)
    return " and ".join(texts)


def checks(effects: Sequence[str]) -> list[str]:
    """What to check on the rig, one line per effect."""
    return [check for _, check, _ in map(_words, effects) if check]


# Parts of a model: what is called wrong with them, and what to check; {0} is the part's name.
PARTS = {
    "joint.frictionloss": ("dry friction", "Turn {0} by hand, unpowered."),
    "joint.damping": ("viscous friction", "Swing {0} unpowered and watch how fast it comes to rest."),
    "joint.armature": ("rotor inertia", "Look up the rotor's inertia of {0}, times its gear ratio squared."),
    "joint.stiffness": ("a spring or a cable", "Move {0} by hand, unpowered: do cables pull it back?"),
    "joint.cogging": ("cogging", "Turn {0} slowly by hand, unpowered: does it snap into places?"),
    "joint.ripple": ("uneven torque of the motor", "Hold {0} against a balance at several angles."),
    "joint.tie": ("softness of a tie", "Hold what {0} is tied to, press on {0}, and measure its give."),
    "joint.springref": ("a spring's rest", "Find where {0} comes to rest, unpowered."),
    "joint.stribeck": ("friction that falls with speed", "Turn {0} slowly, then fast; note the torques."),
    "joint.quadratic_drag": ("drag by the speed squared", "Run {0} at several speeds; note the torques."),
    "joint.direction_friction": ("friction larger one way", "Turn {0} slowly both ways; note the torques."),
    "joint.elasticity": ("gears that give under load", "Hold {0}'s motor still and press on the link."),
    "drive.gravity_compensation": ("drives that carry the weight", "Look it up in the drives."),
    "joint.load_friction": ("friction by the load", "Turn {0} with a load and without; note the torques."),
    "body.mass": ("mass", "Weigh {0}."),
    "body.com": ("centre of mass", "Balance {0} on an edge and measure where it rests."),
    "body.payload": ("a load", "See what is mounted on {0} that the model lacks, cables too."),
    "body.length": ("length of the link before it", "Measure from the joint before {0} to {0}."),
    "geom.friction": ("friction", "Pull a weight across {0} with a spring balance."),
    "geom.stiffness": ("softness of its contact", "Press {0} with a known weight and measure its give."),
    "geom.size": ("size", "Measure {0} with a calliper."),
    "actuator.gain": ("strength", "Command a known torque of {0}, or hold a known weight, and measure."),
    "actuator.damping": ("velocity gain", "Look up the velocity gain in the drive of {0}."),
    "actuator.limit": ("largest force", "Look up the current limit in the drive of {0}."),
    "actuator.fade": ("a drive that falls behind", "Load {0} up to its most and measure its torque."),
    "gravity.direction": ("a base that is tilted", "Put a level on the robot's base."),
}


def _part(name: str) -> tuple[str, str] | None:
    """Name and check of a part of a model, such as `joint:elbow.frictionloss`; None for any other name."""
    kind, of, rest = name.partition(":")
    where, _, what = rest.rpartition(".")
    if not of:  # of the whole model
        return PARTS.get(name)
    if kind not in {part.partition(".")[0] for part in PARTS} or not where:
        return None
    fallback = (what.replace("_", " "), "Measure it of {0}, and set it in the model.")
    called, check = PARTS.get(f"{kind}.{what}", fallback)
    return f"{where}: {called}", check.format(where)


def _words(name: str) -> tuple[str, str, HandEffect | None]:
    """An effect's plain name, what to check ("" if nothing), and the effect itself if it is a hand's."""
    from simgap.robot_effects import words

    robots = words(name) or _part(name)
    if robots is not None:
        return *robots, None
    from simgap.effects import catalogue  # slow to import

    known = catalogue().get(name)
    if known is None:
        return name.replace("_", " "), "", None
    return known.called or name.replace("_", " "), known.check, known


Body = Mapping[str, Any]
CHANNELS = {
    "x": "the hand's sideways position",
    "y": "the hand's height",
    "distance": "the distance of the fingers",
    "offset": "the height difference of the fingers",
    "vx": "the hand's sideways speed",
    "vy": "the hand's vertical speed",
    "fx": "the net sideways force",
    "fy": "the net vertical force",
    "grip": "the grip force",
    "shear": "the difference of the fingers' vertical forces",
}
WHEN = {
    "pregrasp": "while you reach for {0}",
    "pickup": "while you hold {0} on its support",
    "carry": "while you carry {0}",
    "slide": "while you push {0}",
    "place": "while you press {0} down",
    "release": "after you let go of {0}",
    "moving": "while it moves",
    "still": "while it stands still",
}
SAID = 3  # look: most places of a gap in a sentence
SLOW = 1.5  # look: Hz; below it a residual looks like an offset
SURE = ((0.99, "almost certain"), (0.9, "very likely"), (0.7, "likely"), (0.0, "the best guess"))
TINY = 1e-16  # numerics: smallest p-value that double precision resolves next to one


def p_text(p: float) -> str:
    """A p-value; one too small to resolve is only bounded."""
    return f"p = {plain(p, 2)}" if p >= 1e-4 else f"p = {p:.0e}" if p > TINY else "p < 1e-16"


def probability(body: Body) -> float:
    """Probability of what the verdict names."""
    name = "+".join(body["causes"]) or body["verdict"]
    return float(body["probabilities"].get(name, 0.0))


def named(body: Body, rig: Mapping[str, Any] | None = None) -> str:
    """The causes in plain words, with a robot's parameter values."""
    name = "+".join(body["causes"])
    found = body["effects"].get(name, {"parameters": {}})["parameters"]
    means = {k: p["mean"] for k, p in found.items() if p["mean"] is not None}
    if not any(p.get("nominal") is not None for p in found.values()):
        return plain_name(name, means, rig)
    texts = []
    for cause in body["causes"]:
        own = [p for k, p in found.items() if len(body["causes"]) == 1 or k.startswith(f"{cause}.")]
        text = plain_name(cause)
        if len(own) == 1 and _part(cause) is not None and own[0]["unit"] not in ("", "1"):
            shown, nominal = shown_as(own[0]["unit"]), own[0]["nominal"]
            value = estimate(own[0]["mean"], 0.0, shown)
            before = "before" if "changes" in body else "model"
            text += f" {value} ({before}: {plain(shown[0] * nominal) if nominal else 0})"
        texts.append(text)
    return " and ".join(texts)


def headline(body: Body, rig: Mapping[str, Any] | None = None) -> str:
    """The verdict in one line."""
    verdict = body["verdict"]
    if "changes" in body and verdict in ("none", "unknown"):
        return "Nothing changed" if verdict == "none" else "A change that no known cause explains"
    if verdict == "none":
        return "No gap that matters" if body.get("small_gap") else "No gap"
    if verdict == "unknown":
        return "A gap that no known cause explains"
    text = named(body, rig)
    rest = body.get("remainder") or {}
    larger = rest.get("share") is not None and rest["share"] > 0.5 and not _noise(rest)
    more = ", and a larger gap that no known cause explains" if larger else ""
    return text[0].upper() + text[1:] + more


def sentences(body: Body) -> list[str]:
    """What was found, how sure it is, and how far the gap shrinks, for an engineer who must act."""
    verdict, p, small = body["verdict"], p_text(body["detection"]["p_value"]), body.get("small_gap")
    if "changes" in body:
        return changed(body)
    if verdict == "none" and small:
        size = ""
        if small.get("size") is not None:
            size = f": {estimate(small['size'], 0, shown_as(small['unit']))} at most"
        return [f"Recording and model differ ({p}), but by less than matters{size}.", *moving(body)]
    if verdict == "none":
        return [f"The model reproduces the recording to within the sensors' noise ({p})."]
    if verdict == "unknown":
        text = f"Recording and model differ beyond noise ({p}); no known cause explains the larger part."
        return [text, *doubted(body), *moving(body)]
    chance = probability(body)
    word = next(word for least, word in SURE if chance >= least)
    out = [f"{word.capitalize()} ({percent(chance)})."]
    if verdict == "set":
        others = ", or ".join(plain_name(n) for n in body["indistinguishable"])
        out.append(f"These recordings cannot tell it from {others}.")
        instead = {c: o for c, o in (body.get("stands_in") or {}).items() if o and len(body["causes"]) > 1}
        for cause, rivals in instead.items():
            out.append(f"In place of {plain_name(cause)} it may be {' or '.join(map(plain_name, rivals))}.")
    out += [t for t in (explained(body), shrunk(body)) if t]
    return out


def changed(body: Body) -> list[str]:
    """What two sets of logs show about changes of a robot."""
    if body["verdict"] == "none":
        return ["No change that these logs can show: the model fits the new ones as well as the old ones."]
    if body["verdict"] == "unknown":
        over, p = body["remainder"]["rms_over_noise"], p_text(body["remainder"]["p_value"])
        best = [f"The best known explanation, {text}, leaves too much." for text in body["changes"]]
        size = f"The model's error on the new logs is {over:.3g} times that on the old ones"
        return [f"{size} ({p} if nothing changed).", *best]
    p = p_text(body["detection"]["p_value"])
    out = [f"Changed: {'; '.join(body['changes'])} ({p} if nothing changed)."]
    if body["verdict"] == "set":
        others = ", ".join(body["indistinguishable"]) or "the same in other parts"
        out.append(f"These logs cannot tell it from a change of {others}.")
    return out


def doubted(body: Body) -> list[str]:
    """The best explanation of an unknown gap and the doubts about it, if the body has them."""
    best = body.get("explanation") or {}
    doubts = "; ".join(best.get("doubts", ()))
    if not doubts:
        return []
    if not best.get("effects"):
        return [f"With the model calibrated, {doubts}."]
    return [f"The best known explanation, {plain_name('+'.join(best['effects']))}, is doubtful: {doubts}."]


def sentence(body: Body, rig: Mapping[str, Any] | None = None) -> str:
    """The whole finding as a paragraph, for a terminal."""
    text = " ".join([*sentences(body), *remains(body)])
    causes = f" ({', '.join(body['causes'])})" if body["causes"] else ""
    return f"{headline(body, rig)}{causes}. {text}"


def explained(body: Body) -> str:
    """Share of the gap that the causes explain, if the body has it."""
    parts = body.get("attribution", {})
    known = [(n, parts[n]) for n in body["causes"] if parts.get(n, {}).get("share") is not None]
    if not known:
        return ""
    if len(known) == 1:
        own = known[0][1]
        ends = between(*(own.get("interval_90") or (None, None)))
        sure = f" (90 % interval {ends})" if ends else ""
        return f"It explains {percent(own['share'])} of the gap{sure}."
    shares = ", ".join(f"{percent(a['share'])} by {plain_name(n)}" for n, a in known)
    return f"Of the gap, {shares.replace(' by ', ' is explained by ', 1)}."


def shrunk(body: Body) -> str:
    """By how much the gap shrinks."""
    s = body.get("shrinkage")
    if not s or s.get("fraction") is None:
        return ""
    ends = between(*(s.get("interval_90") or (None, None)))
    far = percent(s["fraction"]) + (f" ({ends})" if ends else "")
    it = "them" if len(body["causes"]) > 1 else "it"
    return f"With {it} in the model the gap shrinks by {far} on {s['evaluated_on']}."


def remains(body: Body) -> list[str]:
    """What no cause explains, in words."""
    rest = body.get("remainder")
    if not rest or rest.get("share") is None or body["verdict"] == "none" or "changes" in body:
        return []
    noise = rest.get("rms_over_noise")
    size = f" The whole residual is {plain(noise)} times the noise." if noise else ""
    if body["verdict"] == "unknown":
        return [f"{percent(rest['share'])} of the gap is left after every likely cause.{size}"]
    p = rest.get("p_value")
    sure = "" if p is None else f" ({p_text(p)})"
    if rest["share"] < 0.01 and not _noise(rest):
        return [f"Under 1 % of the gap remains{sure}, which is more than noise.{size}"]
    if _noise(rest):
        return [f"What remains, {percent(rest['share'])} of the gap, is within the noise{sure}.{size}"]
    return [f"{percent(rest['share'])} of the gap remains{sure}.{size}",
            *moving({"where": rest.get("where") or []}, of="what remains")]  # fmt: skip


def _noise(rest: Mapping[str, Any]) -> bool:
    """Whether the remainder is within the noise."""
    p = rest.get("p_value")
    return not rest.get("where") if p is None else p >= 1 - CERTAIN


def settles(body: Body, weighed: bool) -> str:
    """Advice to measure blocks whose properties were fitted; "" if nothing is open or they were `weighed`."""
    rest = body.get("remainder") or {}
    unsure = body["verdict"] in ("set", "unknown") or (
        body["verdict"] == "named" and (probability(body) < SURE[1][0] or (rest.get("share") or 0.0) > 0.5)
    )
    if weighed or not unsure or not any(e.get("property_shift") for e in body["effects"].values()):
        return ""
    return ("Weigh and measure the blocks and pass them with --actual: a sensor error can hide in a "
            "fitted weight or size.")  # fmt: skip


def chances(body: Body) -> dict[str, float]:
    """Probability of each suspect to act; of those that the verdict names, the verdict's probability."""
    known = {n: a["probability"] for n, a in (body.get("attribution") or {}).items()}
    known |= {n: body["probabilities"].get(n, 0.0) for n in body["effects"] if n not in known}
    whole = probability(body)
    known |= {n: whole for n in (*body["causes"], "+".join(body["causes"])) if n in known}
    alone = {n for n in known if "+" not in n}
    return {n: p for n, p in known.items() if n in alone or not set(n.split("+")) <= alone}


def moving(body: Body, of: str = "the gap") -> list[str]:
    """The largest entries of `where` as sentences, with shares `of` the gap or of the remainder."""
    return [_said(place, cells, of) for place, cells in list(by_place(body).items())[:SAID]]


def _said(key: tuple[str, str], cells: Sequence[Mapping[str, Any]], of: str) -> str:
    """A sentence about the cells of one channel and subtask."""
    channel, subtask = key
    what = CHANNELS.get(channel, channel)
    share = share_of(cells)
    largest = max(cells, key=lambda c: c["share"])
    low, high = largest["band"]
    verb = "moves differently"
    if high is None or high <= SLOW:
        verb = "is off"
    elif low >= SLOW:
        verb = f"moves differently above {plain(low, 2)} Hz"
    trials = len({c["trial"] for c in cells})
    often = f"{trials} trial{'s' if trials > 1 else ''}"
    return f"{what[0].upper()}{what[1:]} {verb} {when(subtask)}: {percent(share)} of {of}, in {often}."


def when(subtask: str) -> str:
    """A subtask as an adverbial clause."""
    name, _, block = subtask.partition(" ")
    return WHEN[name].format(block or "the block") if name in WHEN else f"during {subtask}"


def to_do(body: Body) -> list[str]:
    """What to check on the rig, then the next experiment."""
    suspects = [*body["causes"], *body["indistinguishable"]]
    out = checks(suspects)
    following = body.get("next_experiment")
    if following:
        text = ", ".join(plain_name(n) for n in following["separates"])
        out.append(f"Record once more: {following['do']}. That separates: {text}.")
    if body["verdict"] == "unknown" and body["where"]:
        (channel, subtask), *_ = by_place(body)
        what, at = CHANNELS.get(channel, channel), when(subtask)
        out.append(f"Look at {what} {at}, where the gap is largest: what acts there that the model lacks?")
    return out


def by_place(body: Body) -> dict[tuple[str, str], list[Mapping[str, Any]]]:
    """The significant cells by channel and subtask, largest share first."""
    rows: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for cell in (body.get("small_gap") or {}).get("where") or body["where"]:
        rows.setdefault((cell["channel"], cell["subtask"]), []).append(cell)
    return dict(sorted(rows.items(), key=lambda item: -share_of(item[1])))


def share_of(cells: Sequence[Mapping[str, Any]]) -> float:
    """Share of the gap in several cells."""
    return float(sum(c["share"] for c in cells))


def tables(body: Body) -> list[Table]:
    """Tables of probabilities, the cause's parameters, the next experiment and the largest cells."""
    likely = sorted(body["probabilities"].items(), key=lambda item: -item[1])[:6]
    chances = [(name, f"{value:.3f}") for name, value in likely]
    out = [listed("probabilities", ("candidate", "probability"), chances, right=["probability"])]
    if body["causes"]:
        rows = []
        for name, p in body["effects"]["+".join(body["causes"])]["parameters"].items():
            shown, (low, high) = shown_as(p["unit"]), p["interval_90"]
            rows.append((name, estimate(p["mean"], p["sd"], shown), interval(low, high, shown)))
        out.append(listed("parameters", ("parameter", "estimate", "90 % interval"), rows))
    if (following := body["next_experiment"]) is not None:
        gain = f"by {following['expected_gain_nats']:.0f} nats at least"
        separates = f"expected to separate {', '.join(following['separates'])}, {gain}"
        out.append(listed("next experiment", (), [(following["do"],), (separates,)]))
    if body["where"]:
        heads = ("trial", "channel", "subtask", "band [Hz]", "share", "z")
        cells = [
            (c["trial"], c["channel"], c["subtask"], f"{c['band'][0]:g}-{c['band'][1]:g}",
             f"{100 * c['share']:.0f} %", f"{c['z']:.1f}") for c in body["where"][:8]
        ]  # fmt: skip
        out.append(listed("where the gap is largest", heads, cells))
    return out
