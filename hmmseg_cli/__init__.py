"""The `hmmseg` command: one file per command, all built on `console.py`."""

import os

# Matrices are many and small: BLAS threads would wait for each other, and compete with the threads of
# simulators and other workers.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")  # NumPy reads it when it is first imported
