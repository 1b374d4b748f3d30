"""The `hmmseg` command: one file a command, all of them on the frame of `console.py`."""

import os

# Matrices are many and small: BLAS threads would wait for each other, and take turns from simulators' threads
# and from other workers.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")  # NumPy reads it when it is first imported
