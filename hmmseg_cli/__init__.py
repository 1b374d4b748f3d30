"""The `hmmseg` command: one file per command, all built on `console.py`."""

# Python has loaded both anyway: what else is imported, `run` protects.
import os
import sys

# Matrices are many and small: BLAS threads would wait for each other, and compete with the threads of
# simulators and other workers.
for _library in ("OMP", "OPENBLAS", "MKL"):
    os.environ.setdefault(f"{_library}_NUM_THREADS", "1")  # NumPy reads it when it is first imported


def run() -> None:
    """Run the command line as a process, which an interrupt ends without a traceback, whenever it comes."""
    try:
        from hmmseg_cli.main import main

        code = main()
    except KeyboardInterrupt:  # outside the command itself, which handles its own
        code = 130
    import signal

    signal.signal(signal.SIGINT, signal.SIG_IGN)
    sys.exit(code)
