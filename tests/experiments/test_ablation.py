"""Each part that the ablation leaves out is there to be left out."""

import pytest

from experiments.ablation import VARIANTS


@pytest.mark.parametrize("variant", VARIANTS, ids=lambda v: v.name)
def test_every_part_that_is_left_out_exists(variant):
    with variant.without():
        pass
