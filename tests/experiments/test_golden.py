"""Published results stay what they are: recordings/ and made-up ensembles against tests/data/golden."""

import copy

import pytest

from experiments.golden import KINDS, differences, folders, read, rounded

FAST = "none_1"


def same(kind: str, name: str) -> None:
    assert list(differences(read(kind)[name], rounded(KINDS[kind][1](name)))) == []


def test_boundaries_and_properties_are_those_pinned():
    same("identified", FAST)


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in folders() if name != FAST])
def test_boundaries_and_properties_of_the_other_folders(name: str):
    same("identified", name)


@pytest.mark.slow
@pytest.mark.parametrize("kind, name", [(k, n) for k in ("diagnosed", "ensembles") for n in read(k)])
def test_verdicts_shares_and_parameters_are_those_pinned(kind: str, name: str):
    same(kind, name)


def test_what_is_pinned_is_of_every_folder_and_may_move_by_a_share_of_its_sd():
    for kind in ("identified", "diagnosed"):
        assert sorted(read(kind)) == folders()
    old = read("identified")["none_1"]
    for name, (mean, sd) in old["properties"].items():
        for shift, found in ((0.2, 0), (0.3, 1)):
            new = copy.deepcopy(old)
            new["properties"][name] = [mean + shift * sd, sd]
            assert len(list(differences(old, new))) == found


@pytest.mark.parametrize("path, by", [
    (("identified", "none_1", "boundaries", 0, 3, 0), 2e-3),
    (("diagnosed", "force_bias_1", "shares", "force_bias"), 0.06),
    (("diagnosed", "force_bias_1", "shrinkage"), -0.06),
])  # fmt: skip
def test_what_moves_by_more_than_it_may_is_seen(path: tuple, by: float):
    old = read(path[0])[path[1]]
    new = copy.deepcopy(old)
    place = new
    for key in path[2:-1]:
        place = place[key]
    place[path[-1]] += by
    assert len(list(differences(old, new))) == 1
    place[path[-1]] -= 0.9 * by
    assert list(differences(old, new)) == [] and len(list(differences(old, new, exact=True))) == 1
