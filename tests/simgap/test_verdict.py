"""One reading of a posterior over sets: what it must say where that can be worked out by hand."""

import pytest

from simgap.attribution.verdict import ALARM, Explanation, acting, alike, conclude, leading, probabilities

SURE = 1e-12  # a p-value that leaves no doubt of a gap


def one(name: str, weight: float, known: float = 1.0, causes: tuple[str, ...] | None = None) -> Explanation:
    effects = tuple(sorted(name))
    return Explanation(effects, weight, effects if causes is None else causes, known)


def test_probabilities_are_the_weights_where_every_set_is_known():
    found = probabilities([one("a", 0.7), one("ab", 0.2), one("", 0.1)], SURE)
    assert sum(found.values()) == pytest.approx(1.0)
    assert found["a"] == pytest.approx(0.7) and found["a+b"] == pytest.approx(0.2)
    assert found["unknown"] == pytest.approx(0.1) and found["none"] < 1e-6


def test_what_a_set_is_not_known_to_explain_is_unknown():
    found = probabilities([one("a", 0.8, 0.25), one("b", 0.2, 0.5)], SURE)
    assert found["unknown"] == pytest.approx(0.8 * 0.75 + 0.2 * 0.5)
    assert conclude([one("a", 0.8, 0.25), one("b", 0.2, 0.5)], SURE).verdict == "unknown"


def test_at_the_alarm_level_a_gap_is_as_likely_as_none():
    sets = [one("a", 0.9), one("", 0.1)]
    assert probabilities(sets, ALARM)["none"] == pytest.approx(0.5)
    assert acting(sets, ALARM)["a"] == pytest.approx(0.45)
    assert conclude(sets, 1.01 * ALARM).verdict == "none" and conclude(sets, 0.99 * ALARM).verdict == "named"


def test_a_gap_that_does_not_matter_is_none_however_sure():
    told = conclude([one("a", 1.0)], SURE, matters=False)
    assert told.verdict == "none" and told.causes == () and told.probabilities["none"] > 0.99


def test_forced_effects_are_named_whatever_the_gap():
    assert conclude([one("ab", 1.0, 0.0)], 0.9, forced=("b", "a")).causes == ("a", "b")


def test_sets_of_the_same_causes_count_together():
    """Two sets whose smaller effects differ have the same cause, likelier than the single likeliest set."""
    sets = [one("a", 0.4), one("bx", 0.3, causes=("b",)), one("by", 0.3, causes=("b",))]
    assert leading(sets) == ("b",)
    assert conclude(sets, SURE).causes == ("b",)
    assert conclude(sets, SURE, chosen=("a",)).causes == ("a",)


@pytest.mark.parametrize(("odds", "verdict"), [(19.0, "set"), (21.0, "named")])
def test_what_takes_a_causes_place_is_told_down_to_one_in_twenty(odds, verdict):
    weight = odds / (1 + odds)
    told = conclude([one("a", weight), one("b", 1 - weight)], SURE)
    assert told.verdict == verdict and told.indistinguishable == (("b",) if verdict == "set" else ())


def test_an_effect_too_small_to_be_a_cause_is_no_cause_beside_an_alternative_either():
    """Beside a and beside b stands the same small effect s: b takes a's place, s takes nobody's."""
    sets = [one("as", 0.6, causes=("a",)), one("bs", 0.4, causes=("b",))]
    assert alike(sets, ("a",)) == ("b",)


def test_a_larger_set_is_no_alternative():
    assert alike([one("a", 0.5), one("bc", 0.5)], ("a",)) == ()


def test_what_a_set_can_do_without_is_no_cause():
    nested = [one("ab", 0.6), one("a", 0.3), one("", 0.1, 0.0)]
    assert conclude(nested, SURE).causes == ("a",)
    assert conclude([one("ab", 0.96), one("a", 0.03)], SURE).causes == ("a", "b")  # ruled out
    assert conclude([one("ab", 0.6), one("a", 0.3, 0.01)], SURE).causes == ("a", "b")  # it leaves too much
    other = conclude([one("ab", 0.6), one("c", 0.3)], SURE)  # not a part of the set but an alternative to it
    assert other.causes == ("a", "b") and other.indistinguishable == ("c",)
