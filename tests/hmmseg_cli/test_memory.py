"""Freed memory stays with a command's process."""

import subprocess
import sys

import pytest

# Page faults of a loop over arrays that glibc would give back to the system each time.
LOOP = """
import resource
{prepare}
import numpy as np
def touch():
    for _ in range(200):
        arrays = [np.ones(100_000) for _ in range(3)]
touch()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
touch()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


def faults(prepare: str) -> int:
    done = subprocess.run(
        [sys.executable, "-c", LOOP.format(prepare=prepare)], capture_output=True, check=True
    )
    return int(done.stdout)


@pytest.mark.skipif(sys.platform != "linux", reason="a setting of glibc's")
def test_arrays_are_not_asked_for_anew():
    kept = faults("from hmmseg_cli.process import keep_freed_memory; keep_freed_memory()")
    assert kept < 0.05 * faults("")
