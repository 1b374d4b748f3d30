"""The `hmmseg` command: one file a command, all of them on the frame of `console.py`."""
